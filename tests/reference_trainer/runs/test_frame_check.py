"""Which Gaussians lie in which picture, counted by hand."""

import dataclasses
import re

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.ply import check_frame
from reference_trainer.scenes.scene import Scene, View

FORWARD = Camera(torch.eye(4), 10.0, 10.0, 10.0, 5.0, 20, 10)  # 90 degrees wide, 53 high, looks along +z
BACKWARD = Camera(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), 10.0, 10.0, 10.0, 5.0, 20, 10)

IN_FRONT = [0.0, 0.0, 2.0]
TOO_NEAR = [0.0, 0.0, 0.1]
ASIDE = [2.1, 0.0, 2.0]
ABOVE = [0.0, -1.1, 2.0]
BEHIND = [0.0, 0.0, -2.0]


def scene(*cameras):
    views = tuple(View(f"v{i}", camera, torch.zeros(3, 10, 20)) for i, camera in enumerate(cameras))
    return Scene("room", views[:1], views[1:], None, torch.zeros(3))


def model(*points):
    means = torch.tensor([point for point, count in points for _ in range(count)])
    n = len(means)
    return Gaussians.from_points(means, torch.zeros(n, 3), torch.ones(n), sh_degree=0)


def test_a_model_that_is_seen_raises_no_doubt():
    assert check_frame(model((IN_FRONT, 50), (BEHIND, 50)), scene(FORWARD, BACKWARD), "a.ply") == []


@pytest.mark.parametrize("elsewhere", [TOO_NEAR, ASIDE, ABOVE, BEHIND])
def test_nearly_none_is_seen(elsewhere):
    """One of 100 is enough, one of 101 is not."""
    assert check_frame(model((IN_FRONT, 1), (elsewhere, 99)), scene(FORWARD), "a.ply") == []
    behind = 100 if elsewhere in (TOO_NEAR, BEHIND) else 0
    with pytest.raises(
        ValueError,
        match=rf"room .*a\.ply: .*101 Gaussians, 1 \(0\.99%\) .*, {behind} are ",
    ):
        check_frame(model((IN_FRONT, 1), (elsewhere, 100)), scene(FORWARD), "a.ply")


def test_the_message_says_where_both_are():
    points = model(([103.0, 0.0, -5.0], 49), ([100.0, 0.0, -5.0], 2), ([97.0, 0.0, -5.0], 49))
    with pytest.raises(ValueError, match="do not see") as error:
        check_frame(points, scene(FORWARD), "a.ply")
    assert "lies around (100, 0, -5) within 3;" in str(error.value)
    assert re.search(r"around \(0, 0, 0\) within 0 and .*towards \(0, 0, 1\)", str(error.value))
    assert "--format" in str(error.value)


def test_cameras_that_see_nothing_are_named():
    (doubt,) = check_frame(model((IN_FRONT, 100)), scene(FORWARD, BACKWARD), "a.ply")
    assert re.match(r"1 of 2 cameras .*1% of a\.ply: v1\.", doubt)


def test_transparent_gaussians_do_not_count():
    points = model((IN_FRONT, 1), (BEHIND, 1000))
    logits = torch.where(torch.arange(1001) < 1, 0.0, -10.0)
    assert check_frame(dataclasses.replace(points, opacity_logits=logits), scene(FORWARD), "a.ply") == []
    with pytest.raises(ValueError, match=r"1,001 Gaussians .*1/255"):
        check_frame(dataclasses.replace(points, opacity_logits=torch.full((1001,), -10.0)), scene(FORWARD), "a.ply")
