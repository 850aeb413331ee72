"""Commands to look at runs: a page about them, or one of them live. One class each, its fields are the options."""

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

    The models turn, in colors or in co-adaptation heat. It needs nothing but a browser: no server, no network. Several
    runs on one scene stand side by side.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs of `ca-reg train` on one scene, finished or not."""
    out: Path | None = None
    """The file; by default report.html in the folder of the run, or in the one that all of them are in."""
    views: int = 8
    """Views of each split that are shown, evenly chosen."""
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.report.page import write_report

        self.drawing.begin(self.device)
        write_report(self.runs, self.out, views=self.views, device=self.device)


@dataclass(frozen=True)
class View:
    """Turn a run, or any 3DGS PLY, live in a browser.

    Render, co-adaptation, depth or heat, drawn by the renderer. Needs ca_reg[viewer]; Ctrl-C ends it.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`, finished or not, or a standard 3DGS PLY."""
    scene: Annotated[PlyScene, tyro.conf.arg(name="")] = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    regularizer: str | None = None
    """Draw it as if it had been trained with these, such as "dropout(0.2)"."""
    port: int = PORT
    """Of the page, on this machine; 0 for any."""
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
            self.drawing.begin(self.device, trains=True)  # nobody waits for a compiler later
            if where is None:
                model, scene, _ = of_run(self.run, **shared)
                viewer.show(model, measured_views(scene, print))
            else:
                placed = place(self.run, where, background=self.scene.background, **shared)
                viewer.show(placed.model, placed.views)
            print(f"{viewer}; Ctrl-C ends it.", flush=True)
            viewer.serve()
