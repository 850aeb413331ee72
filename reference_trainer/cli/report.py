"""The command that writes a page about runs. Its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from reference_trainer.cli.drawing import Device, Draw, Drawing

__all__ = ["Report"]


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
        """Run the command."""
        from reference_trainer.report.page import write_report

        self.drawing.begin(self.device)
        write_report(self.runs, self.out, views=self.views, device=self.device)
