"""The camera read from a settings tuple, against the INRIA code's own path from the world to a pixel."""

import warnings

import pytest
import torch
from oracles import random_scene

from reference_trainer.compat.rasterizer import camera_of


def test_the_camera_takes_points_where_the_matrices_take_them(settings_of):
    scene = random_scene(50, 40, 24, seed=1)
    settings = settings_of(scene.camera)
    camera = camera_of(settings)
    points = scene.means[5:]
    clip = torch.cat([points, torch.ones(len(points), 1).double()], dim=1) @ settings.projmatrix
    size = torch.tensor([40.0, 24.0]).double()
    integer_centers = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) * 0.5
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    ours = torch.stack([camera.fx * local[:, 0], camera.fy * local[:, 1]], dim=1) / local[:, 2:]
    ours = ours + torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    torch.testing.assert_close(ours - 0.5, integer_centers, rtol=0, atol=1e-9)
    torch.testing.assert_close(camera.position, settings.campos)


def test_in_single_precision_the_center_stays_the_center(settings_of):
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([40.0, -30.0, 70.0])
    camera = random_scene(1, 500, 300, seed=1).camera
    exact = type(camera)(pose, 400.0, 400.0, 250.0, 150.0, 500, 300)
    found = camera_of(settings_of(exact))
    assert abs(found.cx - 250) < 1e-3
    assert abs(found.cy - 150) < 1e-3


@pytest.mark.parametrize("far", [3e4, 1e5])
def test_in_single_precision_a_camera_far_from_the_origin_is_a_pinhole_camera(far, settings_of):
    """As of a town in meters: the fourth row of the matrices' product is as large, and rounds so."""
    camera = random_scene(1, 500, 300, seed=1).camera
    pose = camera.world_to_camera.float()
    pose[:3, 3] = far * torch.tensor([1.0, 0.3, -0.2])
    for focal in (311.0, 407.0, 533.0, 619.0):
        found = camera_of(settings_of(type(camera)(pose, focal, focal, 250.0, 150.0, 500, 300)))
        assert abs(found.cx - 250) < 1e-3
        assert abs(found.cy - 150) < 1e-3


@pytest.mark.parametrize("mistake", ["transposed", "field of view", "moved"])
def test_matrices_that_disagree_are_refused(settings_of, mistake):
    settings = settings_of(random_scene(1, 40, 24, seed=1).camera)
    if mistake == "transposed":
        settings = settings._replace(viewmatrix=settings.viewmatrix.T, projmatrix=settings.projmatrix.T)
    elif mistake == "moved":
        moved = settings.viewmatrix.clone()
        moved[3, :2] += 0.01
        settings = settings._replace(viewmatrix=moved)
    else:
        settings = settings._replace(tanfovx=1.1 * settings.tanfovx)
    with pytest.raises(ValueError, match="pinhole camera"):
        camera_of(settings)


def test_unknown_fields_are_left_out_with_one_warning_each(settings_of):
    camera = random_scene(1, 40, 24, seed=1).camera
    changes = {"kernel_of_the_test": 0.1, "offset_of_the_test": torch.ones(2)}
    changes["sink_of_the_test"] = torch.zeros(2, requires_grad=True)
    nothing = {"none": None, "zeros": torch.zeros(2), "off": False}
    with pytest.warns(UserWarning, match="the setting .*ignores") as warned:
        settings = settings_of(camera, **changes, **nothing)
    assert ["offset" in str(w.message) for w in warned] == [False, True, False]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        settings_of(camera, **changes)
    assert not hasattr(settings, "kernel_of_the_test")
    changed = settings._replace(bg=torch.ones(3))
    assert type(changed) is type(settings)
    assert torch.equal(changed.bg, torch.ones(3))
