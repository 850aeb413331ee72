"""Studies of trained models. One class per study, its fields are the options."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reference_trainer.cli.drawing import Device, Draw, Drawing
from reference_trainer.scenes.options import SceneOptions

__all__ = ["Attribution", "ErrorRuntime", "Paper", "Stability", "Study"]


@dataclass(frozen=True)
class ErrorRuntime:
    """Work-precision diagram: error of every estimator of the score against its run time."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or 3DGS PLY files (seen from an orbit camera)."""
    out: Path = Path("runs/error_runtime")
    """Folder for the JSON, the table and the figure; what was measured is not measured again."""
    max_samples: int = 1024
    """Largest number of renders."""
    seeds: int = 3
    """Independent sequences of masks."""
    device: Device = "cpu"

    def __call__(self) -> None:
        from reference_trainer.studies.error_runtime import error_runtime_study
        from reference_trainer.studies.study import run_study

        study = error_runtime_study(self.sources, max_samples=self.max_samples, seeds=self.seeds, device=self.device)
        run_study(study, self.out)


@dataclass(frozen=True)
class Attribution:
    """Which Gaussians hold the co-adaptation: shares of the exact score, as numbers, pictures and a colored PLY."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    out: Path | None = None
    """Folder for the results; by default <run>/attribution."""
    split: Literal["test", "train"] = "test"
    """Which views."""
    drop_rate: float = 0.5
    """Of the score."""
    device: Device = "cpu"

    def __call__(self) -> None:
        from reference_trainer.studies.gaussian_shares import study_attribution

        study_attribution(self.run, self.out, split=self.split, drop_rate=self.drop_rate, device=self.device)


@dataclass(frozen=True)
class Stability:
    """Extreme cases of both engines against float64 and exact arithmetic: right, refused, or limits, from where on."""

    out: Path = Path("runs/stability")
    """Folder for the JSON, the tables and the picture."""

    def __call__(self) -> None:
        from reference_trainer.studies.stability.stability_study import study_stability

        study_stability(self.out)


@dataclass(frozen=True)
class OwnScene(SceneOptions):
    """A scene of one's own."""

    path: str = ""
    """A scene of your own instead of the declared ones, or "synthetic"; the options that follow are of it."""


@dataclass(frozen=True)
class Paper:
    """Test the paper's claims: train what they need on scenes, keep a row of figures for each, and say what holds.

    What is kept is not trained again: the same command continues, and claims share trainings.
    """

    claims: tuple[str, ...] = ()
    """1 to 17, or comparisons by the names with which --list ends; by default all."""
    scenes: tuple[str, ...] = ()
    """Of the declared scenes, on which not every claim is tested; by default all."""
    data: Path = field(default_factory=lambda: Path(os.environ.get("CA_REG_DATA", "data")))
    """Where the folders of the declared scenes are, each with the name of its scene; by default $CA_REG_DATA."""
    scene: Annotated[OwnScene, tyro.conf.arg(name="")] = field(default_factory=OwnScene)
    recipe: str = "3dgs"
    """Of all trainings but those that are about another."""
    iterations: int = 3_000
    """Steps of every training, to which all schedules are scaled."""
    seeds: int = 3
    """Number of seeds; a claim needs two to be judged."""
    list: bool = False
    """List the trainings, which are kept and how long the others may take; train nothing."""
    pages: tuple[Path, ...] = ()
    """Write what is kept between the marks of these Markdown files; train nothing."""
    figure: Path | None = None
    """Draw what dropout and noise change by their strength and the number of views into this PNG; train nothing."""
    out: Path = Path("runs/paper")
    """Folder for the trainings at work, which are removed when they are kept."""
    rows: Path | None = None
    """Folder of what is kept, NAME.json for each scene; by default --out."""
    jobs: int = 1
    """Trainings at a time."""
    device: Device = "cpu"
    lpips: Annotated[str | None, tyro.conf.arg(help='Perceptual metric: "installed", or a weights file.')] = None
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.files import write_text
        from reference_trainer.runs.engines.processes import Processes
        from reference_trainer.runs.grid import Running
        from reference_trainer.studies.paper.cells import Grid, listing, run_cells
        from reference_trainer.studies.paper.claims import chosen
        from reference_trainer.studies.paper.page import Kept, details, page
        from reference_trainer.studies.paper.scenes import chosen_scenes

        rows = self.rows or self.out
        own = SceneOptions(**asdict(self.scene))
        scenes = chosen_scenes(self.scenes, self.data, own)
        claims = chosen(self.claims, [*scenes] if own.path else None)
        grid = Grid(claims, scenes, self.recipe, self.iterations, self.seeds, self.out, rows)
        kept = Kept(rows, self.recipe, self.iterations)
        for path in self.pages:
            write_text(path, page(path.read_text("utf-8"), kept))
        if self.figure is not None:
            from reference_trainer.studies.paper.figure import gains_figure

            gains_figure(kept, self.figure)
        if self.pages or self.figure:
            return
        if self.list:
            print(listing(grid))
            return
        self.drawing.begin(self.device, trains=True)
        failed = run_cells(grid, Running(Processes(self.jobs), device=self.device, lpips=self.lpips, say=print))
        for name, claim in claims.items():
            print(f"\n{name}. {claim.says}\n\n{details(name, Kept(rows, self.recipe, self.iterations))}")
        for name, why in failed.items():
            print(f"FAILED {name}: {why.error}; the same command tries it again", file=sys.stderr)
        if failed:
            sys.exit(1)


@dataclass(frozen=True)
class Study:
    """Measure something about the method itself."""

    what: ErrorRuntime | Attribution | Stability | Paper

    def __call__(self) -> None:
        self.what()
