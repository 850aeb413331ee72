import dataclasses

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.initial import drawn_by_any, initial_gaussians
from reference_trainer.training.trainer import Trainer

BEHIND = torch.tensor([[0.0, 0.0, -40.0]])


def camera(width: int = 32, height: int = 24) -> Camera:
    return Camera(torch.eye(4), 20.0, 20.0, width / 2, height / 2, width, height)


def with_points(scene: Scene, extra: torch.Tensor) -> Scene:
    """The scene with more initial points at the end of the list."""
    points = scene.points
    positions = torch.cat([points.positions, extra])
    cloud = PointCloud(positions, torch.cat([points.colors, torch.ones_like(extra)]), points.source)
    return dataclasses.replace(scene, points=cloud)


def test_sizes_are_the_distance_to_the_neighbors_times_the_scale(tiny_scene):
    whole = initial_gaussians(tiny_scene, TrainConfig())
    half = initial_gaussians(tiny_scene, TrainConfig(initial_scale=0.5))
    torch.testing.assert_close(half.scales, whole.scales / 2)
    torch.testing.assert_close(half.means, whole.means)


def test_a_gaussian_is_drawn_where_its_footprint_reaches_the_picture():
    """At depth 10 the right edge of the picture is at x = 8; a standard deviation of 1 reaches 2.5 further at 0.1."""
    means = torch.tensor([[0.0, 0.0, 10.0], [9.0, 0.0, 10.0], [40.0, 0.0, 10.0], [0.0, 0.0, -10.0]])
    gaussians = Gaussians.from_points(means, torch.rand(4, 3), torch.ones(4), sh_degree=0)
    view = View("a", camera(), torch.zeros(3, 24, 32))
    assert drawn_by_any(gaussians, (view,)).tolist() == [True, True, False, False]


def test_unseen_points_change_nothing_at_the_training_views(tiny_scene):
    """Without draws, which depend on the number of Gaussians, training is the same but for rounding."""
    scene = with_points(tiny_scene, BEHIND.repeat(3, 1) + torch.arange(3.0)[:, None])
    drawn = drawn_by_any(initial_gaussians(scene, TrainConfig()), scene.train)
    assert torch.nonzero(~drawn).flatten().tolist() == [150, 151, 152]
    config = TrainConfig(iterations=6, sh_every=2, densify_every=0, opacity_reset_from=3)
    everything, seen = (Trainer(scene, dataclasses.replace(config, initial_points=which)) for which in ("all", "seen"))
    everything.train()
    seen.train()
    assert len(seen.gaussians) == len(everything.gaussians) - 3
    for (name, x), (_, y) in zip(everything.gaussians.named(), seen.gaussians.named(), strict=True):
        torch.testing.assert_close(x[:150], y, rtol=1e-4, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")


def test_unseen_points_stay_as_they_began(tiny_scene):
    """That is why they are worth leaving out: no step ever moves them."""
    scene = with_points(tiny_scene, BEHIND.repeat(3, 1) + torch.arange(3.0)[:, None])
    trainer = Trainer(scene, TrainConfig(iterations=4, densify_every=0))
    before = trainer.gaussians.map(lambda x: x.detach()[150:].clone())
    trainer.train()
    for (name, x), (_, y) in zip(before.named(), trainer.gaussians.named(), strict=True):
        assert torch.equal(x, y.detach()[150:]), name


def test_no_point_in_view_says_what_to_do(tiny_scene):
    points = PointCloud(BEHIND.repeat(5, 1) + torch.arange(5.0)[:, None], torch.rand(5, 3), "behind")
    scene = dataclasses.replace(tiny_scene, points=points, train=(View("a", camera(), torch.zeros(3, 24, 32)),))
    with pytest.raises(ValueError, match=r"no initial Gaussian .* training view.*other points"):
        initial_gaussians(scene, TrainConfig(initial_points="seen"))
