"""Studies of the method and of trained models: one class per study, whose fields are its options."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reference_trainer.cli.options import Device, Rendering, RenderOptions
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
    """Number of independent sequences of masks."""
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
    """Drop rate of the score."""
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
    """A scene of your own instead of the declared ones, or "synthetic"; the following options are for it."""


@dataclass(frozen=True)
class Paper:
    """Test the paper's claims: train what they need, keep a row of figures for each training, and say what holds.

    What is kept is not trained again: the same command continues, and claims share trainings.
    """

    claims: tuple[str, ...] = ()
    """1 to 17, or comparisons by the names at the end of --list; by default all."""
    scenes: tuple[str, ...] = ()
    """Names of declared scenes, on which not every claim is tested; by default all."""
    data: Path = field(default_factory=lambda: Path(os.environ.get("CA_REG_DATA", "data")))
    """Parent of the declared scenes' folders, each named like its scene; by default $CA_REG_DATA, else data."""
    scene: Annotated[OwnScene, tyro.conf.arg(name="")] = field(default_factory=OwnScene)
    recipe: str = "3dgs"
    """Recipe of all trainings that do not name another."""
    iterations: int = 3_000
    """Steps of every training, to which all schedules are scaled."""
    seeds: int = 3
    """Number of seeds; a claim needs two to be judged."""
    list: bool = False
    """List the trainings, with those that are kept and the time that the others may take; train nothing."""
    pages: tuple[Path, ...] = ()
    """Update these Markdown files with what is kept, between their marks; train nothing."""
    figure: Path | None = None
    """Plot the effect of dropout and noise against their strength and the number of views, or, with --claims, rank the
    settings of these by what they gain; train nothing."""
    out: Path = Path("runs/paper")
    """Folder for the trainings, each removed once its row is kept."""
    rows: Path | None = None
    """Folder of the kept rows, NAME.json for each scene; by default --out."""
    jobs: int = 1
    """Trainings at a time."""
    device: Device = "cpu"
    lpips: Annotated[str | None, tyro.conf.arg(help='Perceptual metric: "installed", or a weights file.')] = None
    rendering: Rendering = field(default_factory=RenderOptions)

    def __call__(self) -> None:
        from reference_trainer.files import write_text
        from reference_trainer.runs.executors.processes import Processes
        from reference_trainer.runs.grid import Running
        from reference_trainer.studies.paper.cells import Grid, listing, run_cells
        from reference_trainer.studies.paper.claims import chosen
        from reference_trainer.studies.paper.comparison import Kept
        from reference_trainer.studies.paper.page import details, page
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
            from reference_trainer.studies.paper.figure import gains_figure, ranking_figure

            ranking_figure(kept, self.claims, self.figure) if self.claims else gains_figure(kept, self.figure)
        if self.pages or self.figure:
            return
        if self.list:
            print(listing(grid))
            return
        self.rendering.begin(self.device, trains=True)
        failed = run_cells(
            grid,
            Running(Processes(self.jobs), device=self.device, lpips=self.lpips),
        )
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
