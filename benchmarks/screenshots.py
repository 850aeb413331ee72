"""The pictures of the pages that people see: ``python -m benchmarks.screenshots RUN_A RUN_B``.

Needs Chromium, and viser for the viewer. The runs of the pictures in docs/images are two of ``ca-reg compare --path
fern --images images_16 --iterations 3000 --opacity-reset-every 0 --monitor-every 100 --seeds 1``: the baseline and
dropout.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import torch
import tyro

from reference_trainer.evaluation.pictures import save_png
from reference_trainer.report.page import write_report
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.virtual_cameras import measured_views
from reference_trainer.viewer.window import Viewer
from tests.browser import Page

__all__ = ["report_picture", "viewer_picture"]


def report_picture(report: Path) -> torch.Tensor:
    """Return the verdict and the scores of a report, and below them its models, turned, with the curves."""
    with Page(report, 1000, 760) as page:
        page.run("ready.then(() => 0)")
        top = int(page.run("$('compare').getBoundingClientRect().top"))
        first = page.picture()[:, : top - 10]
        page.run("spin(60, -6); $('stage').scrollIntoView(); draw(); 0")
        return torch.cat([first, page.picture()], 1)


def viewer_picture(run: Path) -> torch.Tensor:
    """Return a page of the viewer that shows the exact co-adaptation of a run."""
    model, scene = load_run_model(run)
    with Viewer(0) as viewer:
        viewer.show(model, measured_views(scene))
        viewer._controls[0].value = "co-adaptation"
        with Page(viewer.address, 1000, 640) as page:
            drawn = None
            while drawn is None or time.monotonic() < drawn + 3:  # until the picture has arrived, too
                viewer.update()
                page.run("new Promise(requestAnimationFrame)")
                if drawn is None and "exact CA" in viewer._status.content:
                    drawn = time.monotonic()
            page.run("document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())")
            page.run("new Promise(done => setTimeout(done, 600))")
            return page.picture()


def screenshots(runs: tyro.conf.Positional[tuple[Path, Path]], /, out: Path = Path("docs/images")) -> None:
    """Write ``report.png`` about two runs and ``view.png`` of the first."""
    with tempfile.TemporaryDirectory() as folder:
        save_png(out / "report.png", report_picture(write_report(runs, Path(folder, "report.html"))))
    save_png(out / "view.png", viewer_picture(runs[0]))


if __name__ == "__main__":
    tyro.cli(screenshots)
