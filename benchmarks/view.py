"""What the viewer and the pictures for TensorBoard take: python -m benchmarks.view RUN."""

import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from torch import Tensor

from ca_reg import CAMonitor
from reference_trainer.evaluation.evaluate import training_snapshot
from reference_trainer.evaluation.pictures import as_pillow
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import View
from reference_trainer.scenes.virtual_cameras import interpolate_cameras, measured_views
from reference_trainer.training.trainer import Trainer
from reference_trainer.viewer.picture import DisplayOptions, ViewerModel
from reference_trainer.viewer.window import Viewer
from tests.browser import Page

LOOKS = {
    "render": DisplayOptions(),
    "render, one mask": DisplayOptions(mask=True),
    "co-adaptation": DisplayOptions("co-adaptation"),
    "depth": DisplayOptions("depth"),
    "heat": DisplayOptions("heat"),
    "heat, 10 % hidden": DisplayOptions("heat", hidden=0.1),
}


def timed(function: Callable[[], object]) -> float:
    """Return the seconds that a call takes."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def frames(trainer: Trainer) -> None:
    """Print pictures per second at 400x300 along a flight through the training cameras, JPEG included."""
    views = measured_views(trainer.scene)
    shown = ViewerModel(model_of(trainer), [view for group in views.values() for view in group])
    path = [camera.resized(400, 300) for camera in interpolate_cameras([v.camera for v in trainer.views], 24)]
    print(f"{len(trainer.gaussians):,} Gaussians; heat, once: {timed(lambda: shown.heat):.1f} s")

    def frame(look: DisplayOptions, camera: object) -> None:
        as_pillow(shown.render(look, camera)[0]).save(BytesIO(), "JPEG", quality=90)

    for name, look in LOOKS.items():
        frame(look, path[0])
        seconds = statistics.median(timed(lambda c=camera, x=look: frame(x, c)) for camera in path)
        print(f"{name}: {1 / seconds:.1f} pictures a second")


def first_picture(trainer: Trainer) -> None:
    """Print how long a page waits for its first picture after it has connected."""
    with Viewer(0) as viewer:
        viewer.show(model_of(trainer), measured_views(trainer.scene))
        send, sent = viewer._send, threading.Event()
        viewer._send = lambda window: (send(window), times.append(time.monotonic() - window.moved), sent.set())
        times: list[float] = []
        threading.Thread(target=viewer.serve, daemon=True).start()
        with Page(viewer.address, 1000, 600):
            sent.wait(60)
    print(f"first picture: {times[0]:.2f} s")


def pictures(trainer: Trainer) -> None:
    """Print what the pictures of one measurement take, beside a training step."""
    views, model = {"train": trainer.views, "test": list(trainer.scene.test)}, model_of(trainer)

    def details(opacity: Tensor, view: View) -> dict[str, Tensor]:
        return training_snapshot(model, view)

    with (
        tempfile.TemporaryDirectory() as folder,
        CAMonitor(model.ca_score(), folder, views=views, details=details) as monitor,
    ):
        both = []
        for step in range(12):
            shown = timed(lambda step=step: monitor._show(model.gaussians.opacities, step))
            both.append((shown, timed(trainer.train_step)))
    shown, step = (statistics.median(of) for of in zip(*both[2:], strict=True))
    print(f"{len(trainer.gaussians):,} Gaussians: pictures {shown * 1e3:.0f} ms, {shown / step:.1f} steps' time")


if __name__ == "__main__":
    loaded = load_run(Path(sys.argv[1]))
    frames(loaded)
    first_picture(loaded)
    pictures(Trainer(loaded.scene, loaded.config))
    pictures(loaded)
