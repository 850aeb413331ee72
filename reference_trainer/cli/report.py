"""Commands to look at runs: a page about several, or one live. One class per command, whose fields are its options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from reference_trainer.cli.drawing import Device, Draw, Drawing
from reference_trainer.cli.places import Orbit, PlyScene, place_of
from reference_trainer.cli.runs import PORT
from reference_trainer.scenes.options import OrbitOptions

__all__ = ["Report", "View"]


@dataclass(frozen=True)
class Report:
    """Write one HTML file about runs: scores, views, 3D models.

    The models can be turned, in their colors or in co-adaptation heat. The file needs only a browser: no server, no
    network. Several runs on one scene are shown side by side.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs of `ca-reg train` on one scene, finished or not."""
    out: Path | None = None
    """The file; by default report.html in the folder of the run, or in the deepest one common to all runs."""
    views: int = 8
    """Views of each split that are shown, evenly spaced."""
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.report.page import write_report

        self.drawing.begin(self.device)
        write_report(self.runs, self.out, views=self.views, device=self.device)


@dataclass(frozen=True)
class View:
    """Explore a run, or any 3DGS PLY, live in a browser.

    Shows render, co-adaptation, depth or heat, as this package draws them. Needs ca_reg[viewer]; Ctrl-C ends it.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`, finished or not, or a standard 3DGS PLY."""
    scene: Annotated[PlyScene, tyro.conf.arg(name="")] = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    regularizer: str | None = None
    """Draw it as if it had been trained with these, such as "dropout(0.2)"."""
    port: int = PORT
    """Port of the page on this machine; 0 for any free one."""
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.evaluation.trajectory import measured_views
        from reference_trainer.runs.measure import of_run
        from reference_trainer.runs.score_ply import place
        from reference_trainer.viewer.window import Viewer

        where = place_of(self.run, self.scene, self.orbit)
        shared: dict[str, Any] = {"regularizer": self.regularizer, "device": self.device}
        with Viewer(self.port) as viewer:
            self.drawing.begin(self.device, trains=True)  # so that no later picture waits for the compiler
            if where is None:
                model, scene = of_run(self.run, **shared)
                viewer.show(model, measured_views(scene, print))
            else:
                placed = place(self.run, where, background=self.scene.background, **shared)
                viewer.show(placed.model, placed.views)
            print(f"{viewer}; Ctrl-C ends it.", flush=True)
            viewer.serve()
