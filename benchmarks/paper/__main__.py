"""``python -m benchmarks.paper``: test the paper's claims."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.paper.cells import Grid, listing, run_cells
from benchmarks.paper.claims import chosen
from benchmarks.paper.comparison import RowStore
from benchmarks.paper.figure import course_figure, gains_figure, ranking_figure
from benchmarks.paper.page import details, page
from benchmarks.paper.scenes import chosen_scenes
from reference_trainer.cli.options import Device, Rendering, RenderOptions
from reference_trainer.devices import check_device
from reference_trainer.files import write_text
from reference_trainer.runs.executors import Processes
from reference_trainer.runs.grid import Running
from reference_trainer.scenes.options import SceneOptions

__all__ = ["Paper", "main"]


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
    sequential: bool = False
    """Train more than three seeds only of what a check compares that three leave undecided."""
    list: bool = False
    """List the trainings, with those that are kept and the time that the others may take; train nothing."""
    pages: tuple[Path, ...] = ()
    """Update these Markdown files with what is kept, between their marks; train nothing."""
    figure: Path | None = None
    """Plot the effect of dropout and noise against their strength and the number of views. With --claims, plot the
    course of the trainings that they are about, or else rank their settings by what they gain. Train nothing."""
    out: Path = Path("runs/paper")
    """Folder for the trainings, each removed once its row is kept."""
    rows: Path | None = None
    """Folder of the kept rows, NAME.json for each scene; by default benchmarks/data/paper, for a scene of your own
    --out."""
    jobs: int = 1
    """Trainings at a time."""
    device: Device = "cpu"
    lpips: Annotated[str | None, tyro.conf.arg(help='Perceptual metric: "installed", or a weights file.')] = None
    rendering: Rendering = field(default_factory=RenderOptions)

    def __call__(self) -> None:
        """Do what the options say; exits with code 1 if a training failed."""
        own = SceneOptions(**asdict(self.scene))
        rows = self.rows or (self.out if own.path else Path("benchmarks/data/paper"))
        scenes = chosen_scenes(self.scenes, self.data, own)
        claims = chosen(self.claims, [*scenes] if own.path else None)
        grid = Grid(claims, scenes, self.recipe, self.iterations, self.seeds, self.out, rows, self.sequential)
        store = RowStore(rows, self.recipe, self.iterations)
        for path in self.pages:
            write_text(path, page(path.read_text("utf-8"), store))
        if self.figure is not None:
            courses = self.claims and all("path" in claim.needs for claim in claims.values())
            of_claims = course_figure if courses else ranking_figure
            of_claims(store, self.claims, self.figure) if self.claims else gains_figure(store, self.figure)
        if self.pages or self.figure:
            return
        if self.list:
            print(listing(grid))
            return
        self.rendering.begin(self.device, trains=True)
        failed = run_cells(grid, Running(Processes(self.jobs), device=self.device, lpips=self.lpips))
        for name, claim in claims.items():
            print(f"\n{name}. {claim.says}\n\n{details(name, RowStore(rows, self.recipe, self.iterations))}")
        for name, why in failed.items():
            print(f"FAILED {name}: {why.error}; the same command tries it again", file=sys.stderr)
        if failed:
            sys.exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; errors that a user can fix exit with one line and code 2."""
    command = tyro.cli(
        Paper,
        prog="python -m benchmarks.paper",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )
    try:
        check_device(command.device)
        command()
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"benchmarks.paper: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("\nbenchmarks.paper: interrupted; the same command goes on from what is finished.", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
