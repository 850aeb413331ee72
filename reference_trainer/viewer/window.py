"""The viewer in the browser, by viser: it shows the pictures of a model and reports the user's camera."""

from __future__ import annotations

import contextlib
import io
import math
import os
import socket
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.evaluation.pictures import as_pillow, color_bar, save_film, side_by_side
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import NotFiniteError
from reference_trainer.rotations import rotation_matrices
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.scene import View, Viewpoint
from reference_trainer.scenes.virtual_cameras import interpolate_cameras, measured_views
from reference_trainer.threads import threads_for
from reference_trainer.training.trainer import Trainer
from reference_trainer.viewer.picture import Display, DisplayOptions, Mode, ViewerModel, with_photograph

__all__ = ["Viewer"]

HOST = "127.0.0.1"
STILL = 0.2
"""Seconds without a change after which a picture is rendered at full resolution."""
ROUGH_SECONDS = 0.1
"""Target time of a picture while the camera moves; the resolution adapts to it."""
FEWEST, MOST = 10_000, 1_000_000
"""Limits on the pixels of a picture."""
TRAINING_SHARE = 0.1
"""Fraction of a training's time that showing its new states may take; moving the camera takes more."""
MOVIE_PIXELS, MOVIE_FRAMES = 400_000, 40
"""Of a recorded flight: most pixels of a model's picture, and the number of pictures from one camera to the next."""
BOTH = "side by side"


@dataclass
class _Window:
    """One page."""

    client: Any  # viser's handle
    moved: float  # when it last moved
    due: bool = True  # whether a picture is
    rough: bool = True  # whether the last one was at reduced resolution
    wish: str = ""  # the file that it asked for: "screenshot", "flight" or none
    path: list[Camera] = field(default_factory=list)  # cameras of the flight


class Viewer(contextlib.AbstractContextManager["Viewer", None]):
    """A context manager that serves pages on this machine which show a model, or two with one camera.

    Everything is rendered in the thread that calls `serve` or `follow`: a training is rendered between its steps. It
    listens at ``port``; 0 for any free one.

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
        self._models: dict[str, ViewerModel] = {}
        self._chosen: Any = None  # of several models
        self._photographs: list[View] = []
        self._followed: dict[str, Sequence[Viewpoint]] = {}  # the views of a training
        self._frusta: list[tuple[Any, Any]] = []  # position, and what viser shows there
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

    def show(self, model: TrainedModel, views: Mapping[str, Sequence[Viewpoint]], name: str = "") -> None:
        """Show a model from now on.

        A model of another name is shown beside the first, whose views remain the cameras to jump to.
        """
        device = model.gaussians.means.device
        flat = [view.to(device) for group in views.values() for view in group]
        train = [view for view in views.get("train", ()) if isinstance(view, View)]  # test views must not tell
        if not self._models:
            self._add_cameras(views, model.gaussians)
        elif name not in self._models:
            self._chosen = self._server.gui.add_dropdown("Model", [BOTH, *self._models, name], order=-1)
            self._chosen.on_update(lambda event: self._moved())
        first = next(iter(self._models), name)
        self._models[name] = ViewerModel(model, flat, self._models[first] if name != first else None, train)
        self._moved(still=True)

    def serve(self) -> None:
        """Render whatever pages need until Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                wait = self.update()
                self._changed.wait(1.0 if wait is None else wait)  # Ctrl-C ends no wait without a limit on Windows
                self._changed.clear()

    def follow(self, trainer: Trainer) -> None:
        """Render the model of a training between two of its steps; does nothing while no page is open."""
        if not self._windows:
            return
        start = time.perf_counter()
        new = start >= self._next_model
        if new:
            model = model_of(trainer)
            model = replace(model, gaussians=model.gaussians.map(torch.clone))
            self._followed = self._followed or measured_views(trainer.scene)  # which may have something to say, once
            self.show(model, self._followed)
        with contextlib.suppress(NotFiniteError):  # the training reports it itself
            self.update()
        if new:
            end = time.perf_counter()
            self._next_model = end + (end - start) * (1 / TRAINING_SHARE - 1)

    def update(self) -> float | None:
        """Render for every page that is due; return the seconds until the next is, None if that takes a change."""
        waits = []
        for window in list(self._windows.values()):
            still = time.monotonic() - window.moved
            if window.due or (window.rough and still >= STILL):
                window.due, window.rough = False, still < STILL
                self._send(window)
            if window.wish:
                wish, window.wish = window.wish, ""
                self._save(window, wish)
            if window.rough:
                waits.append(max(0.0, STILL - still))
        return min(waits, default=None)

    def _send(self, window: _Window) -> None:
        """Render one picture and send it to a page."""
        view = window.client.camera
        if not self._models:
            return
        start = time.perf_counter()
        camera = _camera(view, self._rough_pixels if window.rough else MOST)
        displays = self._render(camera)
        if window.client.client_id not in self._windows:  # closed in the meantime
            return
        image = torch.cat([display.image.cpu() for display in displays.values()], 2)
        window.client.scene.set_background_image(np.asarray(as_pillow(image)), format="jpeg", jpeg_quality=90)
        self._hide_nearest_frustum(view.position, beside=len(displays) > 1)
        took = max(1e-3, time.perf_counter() - start)
        if window.rough:
            pixels = self._rough_pixels * min(2.0, max(0.5, ROUGH_SECONDS / took))
            self._rough_pixels = int(min(MOST, max(FEWEST, pixels)))
        else:
            notes = []
            for name, display in displays.items():
                model, title = self._models[name].model, f"**{name}** " * (len(self._models) > 1)
                notes.append(f"{title}step {model.step:,}: {len(model.gaussians):,} Gaussians")
                notes += [display.note] * bool(display.note)
            self._status.content = "\n\n".join([*notes, f"{camera.width}x{camera.height} in {took * 1e3:.0f} ms"])
            if self._bar.visible != (display.scale is not None):
                self._bar.visible = display.scale is not None
            if display.scale is not None:
                self._bar.image = np.asarray(as_pillow(color_bar(*display.scale[:2], width=320)))
                self._bar.label = display.scale[2]

    def _render(self, camera: Camera) -> dict[str, Display]:
        """Return the picture of every model that is chosen, by name; two share the width of the camera."""
        chosen = BOTH if self._chosen is None else self._chosen.value
        names = list(self._models) if chosen == BOTH else [chosen]
        width, displays = max(1, camera.width // len(names)), dict[str, Display]()
        camera = replace(camera, width=width, cx=camera.cx - (camera.width - width) / 2)
        with threads_for(len(names) * width * camera.height):
            for name in names:
                shown = self._models[name]
                try:
                    display = shown.render(self._options, camera)
                except ValueError as error:
                    display = shown.render(DisplayOptions(), camera)._replace(note=str(error))
                if share := self._photograph.value / 100:
                    if (view := self._photograph_at(camera)) is None:
                        notes = filter(None, (display.note, "no photograph from here: go to a camera"))
                        display = display._replace(note="; ".join(notes))
                    else:
                        display = display._replace(image=with_photograph(display.image, camera, view, share))
                displays[name] = display
        return displays

    def _photograph_at(self, camera: Camera) -> View | None:
        """Return the photograph that was taken where a camera stands, None if there is none."""
        near = (v for v in self._photographs if (v.camera.position - camera.position).norm() < 1e-3 * self._distance)
        return next(near, None)

    def _save(self, window: _Window, wish: str) -> None:
        """Render what a page asked for at full resolution, with titles and color bars, and let it download the file."""
        if wish == "screenshot":
            file = io.BytesIO()
            as_pillow(self._sheet(_camera(window.client.camera, MOST))).save(file, "PNG")
            window.client.send_file_download("view.png", file.getvalue(), save_immediately=True)
            return
        cameras = interpolate_cameras(window.path, MOVIE_FRAMES * (len(window.path) - 1) + 1)

        frames = []
        for number, camera in enumerate(cameras):
            self._status.content = f"flight: picture {number + 1} of {len(cameras)}"
            frames.append(self._sheet(camera, notes=False))  # their lengths differ, and so would the pictures
        with tempfile.TemporaryDirectory() as folder:
            film = save_film(Path(folder), "flight", frames)
            window.client.send_file_download(film.name, film.read_bytes(), save_immediately=True)
        self._status.content = f"flight: {len(cameras)} pictures in {film.name}"

    def _sheet(self, camera: Camera, *, notes: bool = True) -> torch.Tensor:
        """Return what a page shows, (3, H, W), with the names of the models, color bars, and the notes on it."""
        displays, mode = self._render(camera), self._options.mode
        return side_by_side(
            [display.image for display in displays.values()],
            [", ".join(filter(None, (name, mode, of.note * notes))) for name, of in displays.items()],
            scales=[display.scale and display.scale[:2] for display in displays.values()],
        )

    @property
    def _options(self) -> DisplayOptions:
        mode, rate, noise, mask, hidden = (control.value for control in self._controls)
        return DisplayOptions(mode, rate, noise, mask, hidden / 100)

    def _add_controls(self) -> None:
        """Fill the panel."""
        gui = self._server.gui
        gui.configure_theme(show_share_button=False, show_logo=False)
        self._controls = [
            gui.add_dropdown("Show", get_args(Mode), hint="Expected error and support are those of the whole model."),
            gui.add_slider("Drop rate", 0.0, 0.95, 0.05, 0.5, hint="Of the co-adaptation, and of the mask."),
            gui.add_slider("Noise", 0.0, 2.0, 0.1, 0.0, hint="Opacity noise: a draw of it, or in the co-adaptation."),
            gui.add_checkbox("Draw a mask", False, hint="Leave Gaussians out at random, as many as the drop rate says, "
                "and turn: colors that need the missing ones change, and groups that co-adapt fall apart."),
            gui.add_slider("Hide %", 0.0, 50.0, 0.5, 0.0, hint="Leave out the Gaussians that co-adapt most for what "
                "they contribute to the pictures, and see what stands without them."),
        ]  # fmt: skip
        hint = "Lay the photograph over the picture, where a camera stands that took one."
        self._photograph = gui.add_slider("Photograph %", 0, 100, 1, 0, hint=hint)
        for control in (*self._controls, self._photograph):
            control.on_update(lambda event: self._moved())
        self._bar = gui.add_image(np.zeros((1, 320, 3), np.uint8), label=" ", visible=False)
        self._status = gui.add_markdown("")
        self._buttons = gui.add_button_group(
            "Save", ("screenshot", "add to path", "flight"),
            hint="A picture; or a flight: move, add the camera to its path, move, add the next, then save the flight.",
        )  # fmt: skip
        self._buttons.on_click(lambda event: self._ask(event.client, self._buttons.value))

    def _ask(self, client: Any, wish: str) -> None:
        """Note what a page asks for; it is rendered by the thread that renders everything."""
        window = self._windows.get(client.client_id) if client is not None else None
        if window is None:
            return
        if wish == "add to path":
            window.path.append(_camera(client.camera, MOVIE_PIXELS))
        if wish == "screenshot" or (wish == "flight" and len(window.path) > 1):
            window.wish = wish
            self._changed.set()
        else:
            cameras = f"{len(window.path)} camera{'s' * (len(window.path) != 1)}"
            self._status.content = f"path: {cameras}; a flight needs 2 or more, 2 s from each to the next"

    def _hide_nearest_frustum(self, position: Any, *, beside: bool) -> None:
        """Hide the frustum that a page looks out of, which would lie across its picture; all of them if ``beside``."""
        for place, frustum in self._frusta:
            visible = not beside and float(np.linalg.norm(place - np.asarray(position))) > 2 * frustum.scale
            if frustum.visible != visible:
                frustum.visible = visible

    def _add_cameras(self, views: Mapping[str, Sequence[Viewpoint]], gaussians: Gaussians) -> None:
        """Add the cameras to the page, to jump to, and start at the first one, with a level horizon."""
        from kornia.geometry.quaternion import Quaternion

        gui, scene = self._server.gui, self._server.scene
        cameras = {f"{split} {view.name}": view.camera.to("cpu") for split, of in views.items() for view in of}
        self._distance = distance = _distance(gaussians, next(iter(cameras.values())))
        self._photographs = [view.to("cpu") for of in views.values() for view in of if isinstance(view, View)]
        size = 0.04 * distance  # of a frustum
        if len(cameras) > 1:
            places = torch.stack([camera.position for camera in cameras.values()])
            size = min(size, 0.25 * nearest_neighbors(places, 1)[0].sqrt().median().item())
        up = _level([*cameras.values()])
        poses = {name: _pose(camera, distance, up) for name, camera in cameras.items()}
        scene.set_up_direction(up.numpy())
        start, at = self._server.initial_camera, poses[next(iter(poses))]
        start.position, start.look_at, start.fov, start.up = (
            at[name] for name in ("position", "look_at", "fov", "up_direction")
        )
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
                wxyz=turned.data.numpy(), position=pose["position"], visible=number > 0,
            )  # fmt: skip
            frustum.on_click(lambda event, pose=pose: self._jump(event.client, pose))
            self._frusta.append((pose["position"], frustum))

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

    def _moved(self, *clients: int, still: bool = False) -> None:
        """Mark these pages, or all, as due for a new picture; as moving unless they are ``still``."""
        for client in clients or list(self._windows):
            if window := self._windows.get(client):
                window.moved, window.due = window.moved if still else time.monotonic(), True
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


def _pose(camera: Camera, distance: float, level: torch.Tensor | None = None) -> dict[str, Any]:
    """Convert a camera on the CPU to properties of viser's, which orbits around a point ``distance`` in front of it.

    ``level`` is the direction that is up in the scene: it replaces that of a camera that is rolled by less than 20
    degrees, unless the camera looks nearly along it.
    """
    position, axes = camera.position, camera.world_to_camera[:3, :3]
    up = -axes[1]
    if level is not None:
        across = level - (level @ axes[2]) * axes[2]
        up = level if across.norm() > 0.2 and across @ up > 0.94 * across.norm() else up
    return {
        "position": position.numpy(),
        "look_at": (position + distance * axes[2]).numpy(),
        "up_direction": up.numpy(),
        "fov": 2 * math.atan(0.5 * camera.height / camera.fy),
    }


def _level(cameras: Sequence[Camera]) -> torch.Tensor:
    """Return the direction (3,) that is up if cameras were held level: perpendicular to their x axes."""
    axes = torch.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    right, up = axes[:, 0], -axes[:, 1].mean(0)
    weak = 0.01 * len(cameras)  # of the mean direction that is up, which decides where parallel axes leave it open
    return torch.nn.functional.normalize(torch.linalg.solve(right.T @ right + weak * torch.eye(3), weak * up), dim=0)


def _distance(gaussians: Gaussians, camera: Camera) -> float:
    """Return the median depth of the Gaussians that a camera sees; 1 if it sees none."""
    depth = camera.depths_of(gaussians.means)
    return depth.median().item() if len(depth) else 1.0
