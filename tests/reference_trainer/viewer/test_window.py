import dataclasses
import math
import sys
import time
from contextlib import nullcontext
from io import BytesIO
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Page
from heard import hearing
from PIL import Image
from scipy.spatial.transform import Rotation

from reference_trainer.camera import Camera
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene, synthetic_scene
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views, orbit_views
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer
from reference_trainer.viewer import window
from reference_trainer.viewer.picture import DisplayOptions, ViewerModel
from reference_trainer.viewer.window import Viewer


class Client:
    """A page that nobody looks at: it remembers what it is sent."""

    client_id = 7

    def __init__(self, camera):
        self.shown, self.files, self._moved = [], {}, None
        self.camera = SimpleNamespace(on_update=lambda call: setattr(self, "_moved", call))
        self.stand_at(camera)
        self.scene = SimpleNamespace(set_background_image=lambda image, **_: self.shown.append(image))
        self.send_file_download = lambda name, content, **_: self.files.update({name: content})
        self.atomic = nullcontext

    def stand_at(self, camera):
        """Look out of a camera, and tell nobody."""
        quaternion = Rotation.from_matrix(camera.world_to_camera[:3, :3].T.double().numpy()).as_quat()  # x, y, z, w
        vars(self.camera).update(
            image_width=camera.width, image_height=camera.height, wxyz=np.roll(quaternion, 1),
            position=camera.position.numpy(), fov=2 * math.atan(0.5 * camera.height / camera.fy),
        )  # fmt: skip

    def move(self, camera=None):
        """Somebody moves to a camera, or only touches it."""
        if camera is not None:
            self.stand_at(camera)
        self._moved(self.camera)

    @property
    def picture(self):
        """The last one that it was sent, (3, H, W)."""
        return torch.from_numpy(self.shown[-1].copy()).permute(2, 0, 1) / 255


class Handle(SimpleNamespace):
    """A part of the panel or of the scene: somebody changes its value, or clicks on it."""

    def __init__(self, value=None, **rest):
        super().__init__(value=value, calls=[], **rest)
        self.on_update = self.on_click = self.calls.append

    def change(self, value, client=None):
        self.value = value
        for call in self.calls:
            call(SimpleNamespace(client=client))


class Server:
    """What `Viewer` uses of viser's server, without a port: its panel by the labels, its scene, and pages that come."""

    def __init__(self, *_, **__):
        self.panel, self.frusta, self.up, self.connect = {}, [], None, None
        self.initial_camera = SimpleNamespace()
        self.gui = SimpleNamespace(
            configure_theme=lambda **_: None,
            add_dropdown=lambda label, options, **_: self._add(label, options[0]),
            add_slider=lambda label, low, high, step, value, **_: self._add(label, value),
            add_checkbox=lambda label, value, **_: self._add(label, value),
            add_button_group=lambda label, options, **_: self._add(label, options[0]),
            add_image=lambda image, label, **rest: self._add(label, image=image, **rest),
            add_markdown=lambda content: self._add("status", content=content),
        )
        self.scene = SimpleNamespace(
            set_up_direction=lambda up: setattr(self, "up", torch.tensor(up)),
            add_frame=lambda *_, **__: Handle(),
            add_camera_frustum=lambda name, fov, aspect, **rest: self.frusta.append(Handle(**rest)) or self.frusta[-1],
        )
        self.on_client_connect = lambda call: setattr(self, "connect", call)
        self.on_client_disconnect = self.stop = lambda *_: None

    def _add(self, label, value=None, **rest):
        self.panel[label] = Handle(value, **rest)
        return self.panel[label]

    @property
    def status(self):
        """The text of the panel."""
        return self.panel["status"].content


@pytest.fixture
def server(monkeypatch):
    """That of the next viewer."""
    server = Server()
    monkeypatch.setattr(pytest.importorskip("viser"), "ViserServer", lambda *_, **__: server)
    return server


@pytest.fixture
def viewer(server):
    with Viewer(0) as viewer:
        yield viewer


def camera_of(page):
    """The camera that a page of viser's stands for."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(page.wxyz, -1)).as_matrix()
    pose[:3, 3] = page.position
    focal, width, height = 0.5 * page.image_height / math.tan(0.5 * page.fov), page.image_width, page.image_height
    inverse = torch.from_numpy(np.linalg.inv(pose)).float()
    return Camera(inverse, focal, focal, width / 2, height / 2, width, height)


def test_a_page_shows_what_the_camera_sees_that_it_jumps_to(run, viewer, server):
    model, scene = load_run_model(run[0])
    viewer.show(model, {"train": scene.train})
    client = Client(scene.train[0].camera.resized(4000, 1000))
    server.connect(client)
    client.settle = lambda: [viewer.update(), time.sleep(window.STILL), viewer.update()]
    client.settle()
    assert client.picture.shape == (3, 500, 2000)  # at most
    for frustum, view in zip(server.frusta, scene.train, strict=True):
        frustum.change(None, client)
        position, ahead = view.camera.position, view.camera.world_to_camera[2, :3]
        np.testing.assert_allclose(client.camera.position, position, atol=1e-6)
        toward = torch.from_numpy(client.camera.look_at) - position
        torch.testing.assert_close(toward / toward.norm(), ahead, rtol=0, atol=1e-5)
        assert client.camera.fov == pytest.approx(2 * math.atan(0.5 * view.camera.height / view.camera.fy))
        client.move(view.camera)  # as the page does with what it was told
        client.settle()
        expected = render_gaussians(
            model.gaussians, view.camera, model.background, opacities=0.8 * model.gaussians.opacities
        )
        torch.testing.assert_close(client.picture, expected.image.clamp(0, 1), rtol=0, atol=0.51 / 255)


def test_a_picture_is_rough_while_somebody_moves_and_full_afterwards(run, viewer, server, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(window, "time", SimpleNamespace(monotonic=lambda: clock[0], perf_counter=time.perf_counter))
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene))
    client = Client(scene.train[0].camera.resized(640, 480))
    server.connect(client)
    for _ in range(2):
        assert viewer.update() == pytest.approx(window.STILL)
        assert client.shown[-1].shape[0] < 480
        clock[0] += 0.75 * window.STILL
        assert viewer.update() == pytest.approx(0.25 * window.STILL)  # there is nothing to do yet
        clock[0] += 0.25 * window.STILL
        assert viewer.update() is None
        expected = render_gaussians(
            model.gaussians, camera_of(client.camera), model.background, opacities=0.8 * model.gaussians.opacities
        )
        torch.testing.assert_close(client.picture, expected.image.clamp(0, 1), rtol=0, atol=0.51 / 255)
        client.move()
    assert len(client.shown) == 4
    viewer.show(model, {})  # no view has a score: a word instead of heat
    server.panel["Show"].change("heat")
    clock[0] += window.STILL
    viewer.update()
    assert "none of the 0 views" in server.status
    np.testing.assert_array_equal(client.shown[-1], client.shown[-2])


@pytest.fixture
def page(run, viewer, server):
    """A page at the first training camera, its picture rendered in full."""
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene), "mine")
    client = Client(scene.train[0].camera)
    server.connect(client)
    client.settle = lambda: [viewer.update(), time.sleep(window.STILL), viewer.update()]
    client.settle()
    return client


def save(server, page, what):
    """Somebody presses a button of the panel."""
    server.panel["Save"].change(what, page)


def test_the_camera_that_a_page_looks_out_of_is_hidden(run, server, page):
    cameras = [view.camera for of in measured_views(load_run_model(run[0])[1]).values() for view in of]
    assert [frustum.visible for frustum in server.frusta] == [False] + [True] * (len(cameras) - 1)
    page.move(cameras[1])
    page.settle()
    assert [frustum.visible for frustum in server.frusta] == [i != 1 for i in range(len(cameras))]


def test_a_photograph_is_laid_over_its_own_camera_only(run, viewer, server, page):
    view = load_run_model(run[0])[1].train[0]
    server.panel["Photograph %"].change(100)
    page.settle()
    torch.testing.assert_close(page.picture, view.image, rtol=0, atol=0.51 / 255)
    page.camera.position = page.camera.position + np.array([0.5, 0, 0])
    page.move()
    page.settle()
    assert "no photograph from here" in server.status
    save(server, page, "screenshot")
    viewer.update()
    with Image.open(BytesIO(page.files["view.png"])) as file:
        assert file.size[0] >= page.shown[-1].shape[1]


@pytest.mark.slow
def test_two_models_share_the_width_and_a_screenshot_names_them(run, scaled, viewer, server, page):
    model, scene = load_run_model(scaled[0])
    viewer.show(model, measured_views(scene), "other")
    server.panel["Show"].change("co-adaptation")
    page.settle()
    camera = camera_of(page.camera)
    half = dataclasses.replace(camera, width=camera.width // 2, cx=camera.width / 4)
    parts = [load_run_model(folder)[0] for folder in (run[0], scaled[0])]
    pictures = [ViewerModel(part, []).render(DisplayOptions("co-adaptation"), half) for part in parts]
    expected = torch.cat([picture.image for picture in pictures], 2)
    torch.testing.assert_close(page.picture, expected, rtol=0, atol=0.51 / 255)
    assert all(f"**{name}**" in server.status for name in ("mine", "other"))
    assert not any(frustum.visible for frustum in server.frusta)
    save(server, page, "screenshot")
    viewer.update()
    with Image.open(BytesIO(page.files["view.png"])) as file:
        sheet = np.asarray(file.convert("RGB")) / 255
    for picture in pictures:  # somewhere below the titles, which may widen the sheet
        part = (picture.image * 255).round().permute(1, 2, 0).numpy() / 255
        rows, columns = (range(size - of + 1) for size, of in zip(sheet.shape[:2], part.shape[:2], strict=True))
        assert any(
            np.abs(sheet[i : i + part.shape[0], j : j + part.shape[1]] - part).max() < 1e-6
            for i in rows for j in columns if np.abs(sheet[i, j] - part[0, 0]).max() < 1e-6
        )  # fmt: skip


def test_a_flight_along_added_cameras_is_a_movie(run, viewer, server, page, monkeypatch):
    monkeypatch.setattr(window, "MOVIE_FRAMES", 6)
    save(server, page, "flight")  # nowhere to fly to
    viewer.update()
    assert not page.files
    for view in load_run_model(run[0])[1].train[:2]:
        page.move(view.camera)
        save(server, page, "add to path")
    assert "2 cameras" in server.status
    save(server, page, "flight")
    viewer.update()
    ((name, content),) = page.files.items()
    assert name in ("flight.webp", "flight.mp4")
    if name == "flight.webp":
        with Image.open(BytesIO(content)) as movie:
            assert movie.n_frames == 7
            assert movie.size[0] >= view.camera.width


def test_a_flight_of_two_models_has_pictures_of_one_size_whatever_their_notes(run, viewer, server, page, monkeypatch):
    monkeypatch.setattr(window, "MOVIE_FRAMES", 4)
    monkeypatch.setitem(sys.modules, "av", None)  # a WebP, which cannot be of several sizes
    rendered, lengths = ViewerModel.render, cycle(range(9))
    monkeypatch.setattr(ViewerModel, "render", lambda *of: rendered(*of)._replace(note="9" * next(lengths)))
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene), "other")
    for view in scene.train[:2]:
        page.move(view.camera.resized(64, 48))  # narrower than its title
        save(server, page, "add to path")
    save(server, page, "flight")
    viewer.update()
    with Image.open(BytesIO(page.files["flight.webp"])) as movie:
        assert movie.n_frames == 5


def test_up_is_across_the_horizontal_axes_of_cameras_held_level(run, viewer, server, monkeypatch):
    def held(yaw, pitch, roll=0.0):
        """World up is z; OpenCV axes."""
        base = Rotation.from_euler("ZXZ", [yaw, -90 - pitch, roll], degrees=True).as_matrix()
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor(base.T, dtype=torch.float32)
        return Camera(pose, 50.0, 50.0, 16.0, 12.0, 32, 24)

    model = load_run_model(run[0])[0]

    def level(cameras):
        with Viewer(0) as other:  # the cameras of one are those of its first model
            other.show(model, {"train": [Viewpoint(str(number), camera) for number, camera in enumerate(cameras)]})
        return server.up

    around = [held(yaw, pitch) for yaw, pitch in zip(range(0, 360, 45), [10, 30, -20, 0, 5, 40, 15, 25], strict=True)]
    up = torch.tensor([0, 0, 1.0])
    assert level(around) @ up == pytest.approx(1, abs=1e-3)
    ahead = [held(-5, 20), held(0, 25), held(7, 15, roll=6)]  # one of them is rolled
    mean = torch.stack([-camera.world_to_camera[1, :3] for camera in ahead]).mean(0)
    horizontal = ahead[0].world_to_camera[0, :3]
    assert abs(level(ahead) @ horizontal) < 0.06
    assert level(ahead) @ mean > 0.9
    assert torch.allclose(level(ahead[:1]), -ahead[0].world_to_camera[1, :3], atol=1e-6)
    # A camera that is rolled slightly is leveled; a portrait, or one that looks straight down, stays as it is.
    server.frusta.clear()
    rolled = {held(7, 15, 6): True, held(0, 0, 90): False, held(0, -90): False}
    up = level([*around, *rolled])
    client = Client(around[0])
    for frustum, (camera, leveled) in zip(server.frusta[len(around) :], rolled.items(), strict=True):
        frustum.change(None, client)
        own = -camera.world_to_camera[1, :3]
        np.testing.assert_array_equal(client.camera.up_direction, (up if leveled else own).numpy())


@pytest.mark.slow
def test_a_training_that_is_watched_ends_with_the_same_model(
    run, options, short, tmp_path, viewer, server, monkeypatch
):
    monkeypatch.setattr(window, "TRAINING_SHARE", 1)  # every state of it is shown
    client = Client(load_scene(options).train[0].camera)
    server.connect(client)
    modes = cycle(["render", "co-adaptation", "depth", "heat"])

    def watch(trainer):
        server.panel["Show"].change(next(modes))
        server.panel["Draw a mask"].change(True)
        server.panel["Hide %"].change(0.0 if trainer.step < 9 else 20.0)
        viewer.follow(trainer)

    results = run_experiment(options, short, tmp_path, monitoring=Monitoring(0), on_step=watch)
    assert len(client.shown) == short.iterations + len(results["views"])  # also while the result is measured
    assert (tmp_path / "point_cloud.ply").read_bytes() == (run[0] / "point_cloud.ply").read_bytes()


def test_a_model_on_a_card_is_shown_from_an_orbit_around_it(run, viewer, server, card):
    model, _ = load_run_model(run[0], str(card))
    cameras = orbit_views(model.gaussians.means, model.gaussians.opacities, count=3, width=32, height=24)
    viewer.show(model, {"orbit": [Viewpoint(str(number), camera) for number, camera in enumerate(cameras)]})
    first = cameras[0].position.cpu().numpy()
    np.testing.assert_allclose(server.initial_camera.position, first, rtol=1e-6)


def test_an_idle_page_waits_for_a_limited_time(server, monkeypatch):
    waits = []

    def wait(timeout=None):
        waits.append(timeout)
        raise KeyboardInterrupt

    event = SimpleNamespace(wait=wait, set=lambda: None, clear=lambda: None)
    monkeypatch.setattr(window, "threading", SimpleNamespace(Event=lambda: event))
    with Viewer(0) as viewer:
        viewer.serve()
    assert 0 < waits[0] <= 1  # on Windows, Ctrl-C is not heard before the end of a wait


def test_a_training_without_test_views_says_so_once(viewer, server, monkeypatch):
    """It was said again for every state of the model."""
    monkeypatch.setattr(window, "TRAINING_SHARE", 1)
    scene = dataclasses.replace(synthetic_scene(width=16, height=12, points=20), test=())
    trainer = Trainer(scene, TrainConfig(iterations=3))
    client = Client(scene.train[0].camera)
    server.connect(client)
    with hearing() as said:
        for _ in range(3):
            trainer.train_step()
            viewer.follow(trainer)
    assert len(client.shown) == 3
    assert sum(line.startswith("No test views") for line in said) == 1


def test_a_training_that_nobody_looks_at_is_left_alone(viewer):
    viewer.follow(None)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")
def test_a_browser_shows_what_was_rendered(run, monkeypatch):
    """With viser's own server."""
    viser, servers = pytest.importorskip("viser"), []
    served = viser.ViserServer
    monkeypatch.setattr(viser, "ViserServer", lambda *of, **named: servers.append(served(*of, **named)) or servers[-1])
    model, scene = load_run_model(run[0])

    def picture(page, mode):
        """Draw what is asked for until the page shows it below its panel; return it, and what it should be."""
        last = time.monotonic() + 60
        while time.monotonic() < last:
            viewer.update()
            page.run("new Promise(requestAnimationFrame)")
            for client in servers[0].get_clients().values():
                expected = ViewerModel(model, []).render(DisplayOptions(mode), camera_of(client.camera)).image
                shown = page.picture()[:, 330:, :500]
                expected = expected[:, 330:, :500]
                if shown.shape == expected.shape and (shown - expected).abs().mean() < 0.02:
                    return shown
        pytest.fail(f"{mode} is not shown")

    with Viewer(0) as viewer, Page(viewer.address, 900, 500) as page:
        viewer.show(model, measured_views(scene))
        render = picture(page, "render")
        page.run("document.querySelector('input[value=render]').click()")
        page.run("[...document.querySelectorAll('[role=option]')].find(x => x.textContent == 'depth').click()")
        depth = picture(page, "depth")
        assert (render - depth).abs().mean() > 0.1
        assert all(address.startswith((viewer.address, "data:", "blob:")) for address in page.requests)
        assert not page.complaints
