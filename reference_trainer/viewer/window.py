"""The viewer in the browser, by viser: it shows the pictures of a model and reports the user's camera."""

from __future__ import annotations

import contextlib
import io
import math
import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import torch

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.evaluation.pictures import as_pillow
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import NotFiniteError
from reference_trainer.rotations import rotation_matrices
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views
from reference_trainer.threads import threads_for
from reference_trainer.training.trainer import Trainer
from reference_trainer.viewer.picture import DisplayOptions, Mode, ViewerModel

__all__ = ["Viewer"]

HOST = "127.0.0.1"
STILL = 0.2
"""Seconds without a change after which a picture is drawn at full resolution."""
ROUGH_SECONDS = 0.1
"""Target time of a picture while the camera moves; the resolution adapts to it."""
FEWEST, MOST = 10_000, 1_000_000
"""Limits on the pixels of a picture."""
TRAINING_SHARE = 0.1
"""Fraction of a training's time that showing its new states may take; moving the camera takes more."""


@dataclass
class _Window:
    """One page: when it last moved, whether a picture is due, and whether the last one was at reduced resolution."""

    client: Any
    moved: float
    due: bool = True
    rough: bool = True


class Viewer(contextlib.AbstractContextManager["Viewer", None]):
    """A context manager that serves pages on this machine which show a model.

    Everything is drawn in the thread that calls `serve` or `follow`: a training is drawn between its steps.

    Args:
        port: to listen at; 0 for any free one.

    Raises:
        ImportError: if viser is missing.
        OSError: if the port cannot be used.
        ValueError: if it is no port number.
    """

    def __init__(self, port: int) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError("the viewer needs viser: pip install 'ca_reg[viewer]'.") from error
        if not 0 <= port < 65536:
            raise ValueError(f"a port is a number from 0 to 65535, got {port}.")
        try:
            socket.create_server((HOST, port)).close()  # viser would take another port
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            raise OSError(f"port {port} cannot be used for the viewer ({reason}): give another one.") from error
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(HOST, port, label="ca_reg", verbose=False)
        self._model: ViewerModel | None = None
        self._windows: dict[int, _Window] = {}
        self._changed = threading.Event()
        self._rough_pixels, self._next_model = 40_000, 0.0
        self._add_controls()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(lambda client: self._windows.pop(client.client_id, None))

    @property
    def address(self) -> str:
        """URL of the page."""
        return f"http://{HOST}:{self._server.get_port()}"

    def __str__(self) -> str:
        port = self._server.get_port()
        return f"The viewer is at {self.address}, from another machine after: ssh -L {port}:{HOST}:{port} THIS_ONE"

    def __exit__(self, *error: object) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def show(self, model: TrainedModel, views: Mapping[str, Sequence[Viewpoint]]) -> None:
        """Show a model from now on. The first call's views, by split, become the cameras to jump to."""
        flat = [view.to(model.gaussians.means.device) for group in views.values() for view in group]
        if self._model is None:
            self._add_cameras(views, model.gaussians)
        self._model = ViewerModel(model, flat)
        for window in list(self._windows.values()):
            window.due = True
        self._changed.set()

    def serve(self) -> None:
        """Draw whatever pages need until Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                self._changed.wait(self.update())
                self._changed.clear()

    def follow(self, trainer: Trainer) -> None:
        """Draw the model of a training between two of its steps; does nothing while no page is open."""
        if not self._windows:
            return
        start = time.perf_counter()
        new = start >= self._next_model
        if new:
            model = model_of(trainer)
            model = replace(model, gaussians=model.gaussians.map(torch.clone))
            self.show(model, measured_views(trainer.scene))
        with contextlib.suppress(NotFiniteError):  # the training reports it itself
            self.update()
        if new:
            end = time.perf_counter()
            self._next_model = end + (end - start) * (1 / TRAINING_SHARE - 1)

    def update(self) -> float | None:
        """Render for every page that is due; return the seconds until the next one is, None if that takes a change."""
        waits = []
        for window in list(self._windows.values()):
            still = time.monotonic() - window.moved
            if window.due or (window.rough and still >= STILL):
                window.due, window.rough = False, still < STILL
                self._send(window)
            if window.rough:
                waits.append(max(0.0, STILL - still))
        return min(waits, default=None)

    def _send(self, window: _Window) -> None:
        """Draw one picture and send it to a page."""
        shown, view = self._model, window.client.camera
        if shown is None:
            return
        start = time.perf_counter()
        camera = _camera(view, self._rough_pixels if window.rough else MOST)
        with threads_for(camera.width * camera.height):
            try:
                image, note = shown.render(self._options, camera)
            except ValueError as error:
                (image, _), note = shown.render(DisplayOptions(), camera), str(error)
        if window.client.client_id not in self._windows:  # closed in the meantime
            return
        window.client.scene.set_background_image(np.asarray(as_pillow(image)), format="jpeg", jpeg_quality=90)
        took, model = max(1e-3, time.perf_counter() - start), shown.model
        if window.rough:
            pixels = self._rough_pixels * min(2.0, max(0.5, ROUGH_SECONDS / took))
            self._rough_pixels = int(min(MOST, max(FEWEST, pixels)))
        else:
            drawn = f"{len(model.gaussians):,} Gaussians, {camera.width}x{camera.height} in {took * 1e3:.0f} ms"
            self._status.content = f"step {model.step:,}: {drawn}\n\n{note}"

    @property
    def _options(self) -> DisplayOptions:
        mode, rate, noise, mask, hidden = (control.value for control in self._controls)
        return DisplayOptions(mode, rate, noise, mask, hidden / 100)

    def _add_controls(self) -> None:
        """Fill the panel."""
        gui = self._server.gui
        gui.configure_theme(show_share_button=False, show_logo=False)
        self._controls = [
            gui.add_dropdown("Show", get_args(Mode)),
            gui.add_slider("Drop rate", 0.0, 0.95, 0.05, 0.5, hint="Of the co-adaptation, and of the mask."),
            gui.add_slider("Noise", 0.0, 2.0, 0.1, 0.0, hint="Opacity noise: a draw of it, or in the co-adaptation."),
            gui.add_checkbox("Draw a mask", False, hint="Leave Gaussians out at random, at the drop rate."),
            gui.add_slider("Hide %", 0.0, 50.0, 0.5, 0.0, hint="Leave out those that co-adapt most."),
        ]
        for control in self._controls:
            control.on_update(lambda event: self._moved())
        self._status = gui.add_markdown("")

    def _add_cameras(self, views: Mapping[str, Sequence[Viewpoint]], gaussians: Gaussians) -> None:
        """Add the cameras to the page, to jump to, and start at the first one."""
        from kornia.geometry.quaternion import Quaternion

        gui, scene = self._server.gui, self._server.scene
        cameras = {f"{split} {view.name}": view.camera.to("cpu") for split, of in views.items() for view in of}
        distance = _distance(gaussians, next(iter(cameras.values())))
        size = 0.04 * distance  # of a frustum
        if len(cameras) > 1:
            places = torch.stack([camera.position for camera in cameras.values()])
            size = min(size, 0.25 * nearest_neighbors(places, 1)[0].sqrt().median().item())
        poses = {name: _pose(camera, distance) for name, camera in cameras.items()}
        scene.set_up_direction(sum(pose["up_direction"] for pose in poses.values()))
        start, at = self._server.initial_camera, poses[next(iter(poses))]
        start.position, start.look_at, start.fov = at["position"], at["look_at"], at["fov"]
        folder = scene.add_frame("/cameras", show_axes=False)
        chooser = gui.add_dropdown("Go to", list(cameras))
        chooser.on_update(lambda event: self._jump(event.client, poses[chooser.value]))
        shown = gui.add_checkbox("Cameras", True)
        shown.on_update(lambda event: setattr(folder, "visible", shown.value))
        for number, (name, camera) in enumerate(cameras.items()):
            pose = poses[name]
            turned = Quaternion.from_matrix(camera.world_to_camera[:3, :3].T)
            frustum = scene.add_camera_frustum(
                f"/cameras/{number}", pose["fov"], camera.width / camera.height, scale=size,
                thickness=0.02 * size, color=(230, 90, 30) if name.startswith("train") else (60, 120, 220),
                wxyz=turned.data.numpy(), position=pose["position"],
            )  # fmt: skip
            frustum.on_click(lambda event, pose=pose: self._jump(event.client, pose))

    def _jump(self, client: Any, pose: Mapping[str, Any]) -> None:
        """Move a page to a camera."""
        if client is not None:  # None if the server has set the value
            with client.atomic():
                for name, value in pose.items():
                    setattr(client.camera, name, value)

    def _connected(self, client: Any) -> None:
        """Register a new page."""
        self._windows[client.client_id] = _Window(client, time.monotonic())
        client.camera.on_update(lambda camera: self._moved(client.client_id))
        self._changed.set()

    def _moved(self, *clients: int) -> None:
        """Mark these pages, or all, as due for a new picture."""
        for client in clients or list(self._windows):
            if window := self._windows.get(client):
                window.moved, window.due = time.monotonic(), True
        self._changed.set()


def _camera(view: Any, most: int) -> Camera:
    """Convert viser's camera to ours, with at most ``most`` pixels."""
    scale = min(1.0, math.sqrt(most / max(1, view.image_width * view.image_height)))  # a page may have no area
    width, height = (max(1, round(scale * side)) for side in (view.image_width, view.image_height))
    focal = 0.5 * height / math.tan(0.5 * view.fov)
    from_camera = torch.eye(4, dtype=torch.float64)
    from_camera[:3, :3] = rotation_matrices(torch.tensor(view.wxyz)[None])[0]
    from_camera[:3, 3] = torch.tensor(view.position)
    return Camera(from_camera.inverse().float(), focal, focal, width / 2, height / 2, width, height)


def _pose(camera: Camera, distance: float) -> dict[str, Any]:
    """Convert a camera on the CPU to properties of viser's, which orbits around a point ``distance`` in front of it."""
    position, axes = camera.position, camera.world_to_camera[:3, :3]
    return {
        "position": position.numpy(),
        "look_at": (position + distance * axes[2]).numpy(),
        "up_direction": (-axes[1]).numpy(),
        "fov": 2 * math.atan(0.5 * camera.height / camera.fy),
    }


def _distance(gaussians: Gaussians, camera: Camera) -> float:
    """Return the median depth of the Gaussians that a camera sees; 1 if it sees none."""
    pixels, depth = camera.project(gaussians.means)
    depth = depth[camera.inside(pixels, depth)]
    return depth.median().item() if len(depth) else 1.0
