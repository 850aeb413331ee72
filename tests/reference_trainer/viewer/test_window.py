import dataclasses
import sys
import time
from io import BytesIO
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Page
from PIL import Image
from scipy.spatial.transform import Rotation

from reference_trainer.camera import Camera
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views, orbit_views
from reference_trainer.viewer import window
from reference_trainer.viewer.picture import DisplayOptions, ViewerModel
from reference_trainer.viewer.window import MOST, Viewer, _camera, _level, _pose


class Client:
    """A page that nobody looks at: it remembers what it is sent."""

    client_id = 7

    def __init__(self, camera):
        self.shown = []
        at = _pose(camera, 1.0)
        axes = camera.world_to_camera[:3, :3].T.double().numpy()
        wxyz = pytest.importorskip("viser").transforms.SO3.from_matrix(axes).wxyz
        self.camera = SimpleNamespace(
            image_width=camera.width, image_height=camera.height, wxyz=wxyz, position=at["position"], fov=at["fov"],
            on_update=lambda call: None,
        )  # fmt: skip
        self.scene = SimpleNamespace(set_background_image=lambda image, **_: self.shown.append(image))
        self.files = {}
        self.send_file_download = lambda name, content, **_: self.files.update({name: content})


@pytest.fixture
def viewer():
    pytest.importorskip("viser")
    with Viewer(0) as viewer:
        yield viewer


def test_a_camera_of_the_page_is_the_one_that_was_jumped_to(run):
    for view in load_run_model(run[0])[1].train:
        camera = _camera(Client(view.camera).camera, MOST)
        torch.testing.assert_close(camera.world_to_camera, view.camera.world_to_camera, rtol=1e-5, atol=1e-5)
        assert (camera.width, camera.height) == (view.camera.width, view.camera.height)
        assert camera.fy == pytest.approx(view.camera.fy)
    assert _camera(Client(view.camera.resized(4000, 1000)).camera, MOST).width == 2000


def test_a_picture_is_rough_while_somebody_moves_and_full_afterwards(run, viewer, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(window, "time", SimpleNamespace(monotonic=lambda: clock[0], perf_counter=time.perf_counter))
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene))
    camera = scene.train[0].camera.resized(640, 480)
    client = Client(camera)
    viewer._connected(client)
    for _ in range(2):
        assert viewer.update() == pytest.approx(window.STILL)
        assert client.shown[-1].shape[0] < 480
        clock[0] += 0.75 * window.STILL
        assert viewer.update() == pytest.approx(0.25 * window.STILL)  # there is nothing to do yet
        clock[0] += 0.25 * window.STILL
        assert viewer.update() is None
        expected = render_gaussians(
            model.gaussians, _camera(client.camera, MOST), model.background, opacities=0.8 * model.gaussians.opacities
        )
        shown = torch.from_numpy(client.shown[-1].copy()).permute(2, 0, 1) / 255
        torch.testing.assert_close(shown, expected.image.clamp(0, 1), rtol=0, atol=0.5001 / 255)
        viewer._moved()
    assert len(client.shown) == 4
    viewer._controls[0].value = "heat"
    viewer._models[""] = ViewerModel(model, [])  # no view has a score: a word instead of heat
    viewer._moved()
    clock[0] += window.STILL
    viewer.update()
    assert "none of the 0 views" in viewer._status.content
    np.testing.assert_array_equal(client.shown[-1], client.shown[-2])


@pytest.fixture
def page(run, viewer):
    """A page at the first training camera, its picture rendered in full."""
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene), "mine")
    client = Client(scene.train[0].camera)
    viewer._connected(client)
    client.settle = lambda: [viewer.update(), time.sleep(window.STILL), viewer.update()]
    client.settle()
    return client


def test_the_camera_that_a_page_looks_out_of_is_hidden(run, viewer, page):
    cameras = [view.camera for of in measured_views(load_run_model(run[0])[1]).values() for view in of]
    assert [frustum.visible for _, frustum in viewer._frusta] == [False] + [True] * (len(cameras) - 1)
    page.camera = Client(cameras[1]).camera
    viewer._moved()
    page.settle()
    assert [frustum.visible for _, frustum in viewer._frusta] == [i != 1 for i in range(len(cameras))]


def test_a_photograph_is_laid_over_its_own_camera_only(run, viewer, page):
    view = load_run_model(run[0])[1].train[0]
    viewer._photograph.value = 100
    viewer._moved()
    page.settle()
    shown = torch.from_numpy(page.shown[-1].copy()).permute(2, 0, 1) / 255
    torch.testing.assert_close(shown, view.image, rtol=0, atol=0.51 / 255)
    page.camera.position = page.camera.position + np.array([0.5, 0, 0])
    viewer._moved()
    page.settle()
    assert "no photograph from here" in viewer._status.content
    viewer._ask(page, "screenshot")
    viewer.update()
    with Image.open(BytesIO(page.files["view.png"])) as file:
        assert file.size[0] >= page.shown[-1].shape[1]


@pytest.mark.slow
def test_two_models_share_the_width_and_a_screenshot_names_them(run, scaled, viewer, page):
    model, scene = load_run_model(scaled[0])
    viewer.show(model, measured_views(scene), "other")
    viewer._controls[0].value = "co-adaptation"
    viewer._moved()
    page.settle()
    camera = _camera(page.camera, MOST)
    half = dataclasses.replace(camera, width=camera.width // 2, cx=camera.width / 4)
    parts = [load_run_model(folder)[0] for folder in (run[0], scaled[0])]
    pictures = [ViewerModel(part, []).render(DisplayOptions("co-adaptation"), half) for part in parts]
    shown = torch.from_numpy(page.shown[-1].copy()).permute(2, 0, 1) / 255
    expected = torch.cat([picture.image for picture in pictures], 2)
    torch.testing.assert_close(shown, expected, rtol=0, atol=0.51 / 255)
    assert all(f"**{name}**" in viewer._status.content for name in ("mine", "other"))
    assert not any(frustum.visible for _, frustum in viewer._frusta)
    viewer._ask(page, "screenshot")
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


def test_a_flight_along_added_cameras_is_a_movie(run, viewer, page, monkeypatch):
    monkeypatch.setattr(window, "MOVIE_FRAMES", 6)
    viewer._ask(page, "flight")  # nowhere to fly to
    viewer.update()
    assert not page.files
    for view in load_run_model(run[0])[1].train[:2]:
        page.camera = Client(view.camera).camera
        viewer._ask(page, "add to path")
    assert "2 cameras" in viewer._status.content
    viewer._ask(page, "flight")
    viewer.update()
    ((name, content),) = page.files.items()
    assert name in ("flight.webp", "flight.mp4")
    if name == "flight.webp":
        with Image.open(BytesIO(content)) as movie:
            assert movie.n_frames == 7
            assert movie.size[0] >= view.camera.width


def test_a_flight_of_two_models_has_pictures_of_one_size_whatever_their_notes(run, viewer, page, monkeypatch):
    monkeypatch.setattr(window, "MOVIE_FRAMES", 4)
    monkeypatch.setitem(sys.modules, "av", None)  # a WebP, which cannot be of several sizes
    rendered, lengths = ViewerModel.render, cycle(range(9))
    monkeypatch.setattr(ViewerModel, "render", lambda *of: rendered(*of)._replace(note="9" * next(lengths)))
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene), "other")
    for view in scene.train[:2]:
        page.camera = Client(view.camera.resized(64, 48)).camera  # narrower than its title
        viewer._ask(page, "add to path")
    viewer._ask(page, "flight")
    viewer.update()
    with Image.open(BytesIO(page.files["flight.webp"])) as movie:
        assert movie.n_frames == 5


def test_up_is_across_the_horizontal_axes_of_cameras_held_level():
    def held(yaw, pitch, roll=0.0):
        """World up is z; OpenCV axes."""
        base = Rotation.from_euler("ZXZ", [yaw, -90 - pitch, roll], degrees=True).as_matrix()
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor(base.T, dtype=torch.float32)
        return Camera(pose, 50.0, 50.0, 16.0, 12.0, 32, 24)

    around = [held(yaw, pitch) for yaw, pitch in zip(range(0, 360, 45), [10, 30, -20, 0, 5, 40, 15, 25], strict=True)]
    assert _level(around) @ torch.tensor([0, 0, 1.0]) == pytest.approx(1, abs=1e-3)
    ahead = [held(-5, 20), held(0, 25), held(7, 15, roll=6)]  # one of them is rolled
    mean = torch.stack([-camera.world_to_camera[1, :3] for camera in ahead]).mean(0)
    level = ahead[0].world_to_camera[0, :3]
    assert abs(_level(ahead) @ level) < 0.06
    assert torch.allclose(_level(ahead[:1]), -ahead[0].world_to_camera[1, :3], atol=1e-6)
    assert _level(ahead) @ mean > 0.9
    # A camera that is rolled slightly is leveled; a portrait, or one that looks straight down, stays as it is.
    up = torch.tensor([0, 0, 1.0])
    for camera, leveled in ((held(7, 15, 6), True), (held(0, 0, 90), False), (held(0, -90), False)):
        own = (-camera.world_to_camera[1, :3]).numpy()
        np.testing.assert_array_equal(_pose(camera, 1.0, up)["up_direction"], up.numpy() if leveled else own)


@pytest.mark.slow
def test_a_training_that_is_watched_ends_with_the_same_model(run, options, short, tmp_path, viewer):
    client = Client(load_scene(options).train[0].camera)
    viewer._connected(client)
    modes = cycle(["render", "co-adaptation", "depth", "heat"])

    def watch(trainer):
        viewer._next_model = 0.0
        viewer._controls[0].value = next(modes)
        viewer._controls[3].value = True
        viewer._controls[4].value = 0.0 if trainer.step < 9 else 20.0
        viewer.follow(trainer)

    results = run_experiment(options, short, tmp_path, monitoring=Monitoring(0), on_step=watch)
    assert len(client.shown) == short.iterations + len(results["views"])  # also while the result is measured
    assert (tmp_path / "point_cloud.ply").read_bytes() == (run[0] / "point_cloud.ply").read_bytes()


def test_a_model_on_a_card_is_shown_from_an_orbit_around_it(run, viewer, card):
    model, _ = load_run_model(run[0], str(card))
    cameras = orbit_views(model.gaussians.means, model.gaussians.opacities, count=3, width=32, height=24)
    viewer.show(model, {"orbit": [Viewpoint(str(number), camera) for number, camera in enumerate(cameras)]})
    first = cameras[0].position.cpu().numpy()
    np.testing.assert_allclose(viewer._server.initial_camera.position, first, rtol=1e-6)


def test_an_idle_page_waits_for_a_limited_time(viewer, monkeypatch):
    waits = []

    def wait(timeout=None):
        waits.append(timeout)
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer._changed, "wait", wait)
    viewer.serve()
    assert 0 < waits[0] <= 1  # on Windows, Ctrl-C is not heard before the end of a wait


def test_a_training_that_nobody_looks_at_is_left_alone(viewer):
    viewer.follow(None)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")
def test_a_browser_shows_what_was_rendered(run, viewer):
    model, scene = load_run_model(run[0])
    viewer.show(model, measured_views(scene))

    def picture(page, mode):
        """Draw what is asked for until the page shows it below its panel; return it, and what it should be."""
        last = time.monotonic() + 60
        while time.monotonic() < last:
            viewer.update()
            page.run("new Promise(requestAnimationFrame)")
            if viewer._windows and viewer._options.mode == mode:
                (only,) = viewer._windows.values()
                expected = viewer._models[""].render(DisplayOptions(mode), _camera(only.client.camera, MOST)).image
                shown = page.picture()[:, 330:, :500]
                expected = expected[:, 330:, :500]
                if shown.shape == expected.shape and (shown - expected).abs().mean() < 0.02:
                    return shown
        pytest.fail(f"{mode} is not shown")

    with Page(viewer.address, 900, 500) as page:
        render = picture(page, "render")
        page.run("document.querySelector('input[value=render]').click()")
        page.run("[...document.querySelectorAll('[role=option]')].find(x => x.textContent == 'depth').click()")
        depth = picture(page, "depth")
        assert (render - depth).abs().mean() > 0.1
        assert all(address.startswith((viewer.address, "data:", "blob:")) for address in page.requests)
        assert not page.complaints
