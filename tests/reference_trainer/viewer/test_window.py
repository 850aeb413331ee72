import time
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Page

from reference_trainer.model.rendering import render_gaussians
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views, orbit_views
from reference_trainer.viewer import window
from reference_trainer.viewer.picture import DisplayOptions, ViewerModel
from reference_trainer.viewer.window import MOST, Viewer, _camera, _pose


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
    viewer._model = ViewerModel(model, [])  # no view has a score: a word instead of heat
    viewer._moved()
    clock[0] += window.STILL
    viewer.update()
    assert "none of the 0 views" in viewer._status.content
    np.testing.assert_array_equal(client.shown[-1], client.shown[-2])


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


def test_a_training_that_nobody_looks_at_is_left_alone(viewer):
    viewer.follow(None)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")
def test_a_browser_shows_what_was_drawn(run, viewer):
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
                expected, _ = viewer._model.render(DisplayOptions(mode), _camera(only.client.camera, MOST))
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
