"""The comparison of models against its formula, and the cameras that it is made from."""

import dataclasses

import numpy as np
import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.evaluation.metrics import ssim
from reference_trainer.scenes.scene import PointCloud
from reference_trainer.scenes.virtual_cameras import depth_bounds, pseudo_cameras
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.trainer import Trainer

BRIGHTER = torch.full((6, 1, 3), 0.4, dtype=torch.float64)


@pytest.fixture
def scene(tiny_scene, three_views):
    positions = torch.tensor([[0.0, 0.0, 3.0], [0.3, 0.1, 4.0], [-0.2, 0.1, 6.0]], dtype=torch.float64)
    return dataclasses.replace(tiny_scene, train=tuple(three_views), points=PointCloud(positions, positions, "hand"))


def joined(*steps):
    """Steps of the models of one training."""
    for step in steps:
        step.siblings = steps
    return steps


@pytest.mark.parametrize("count", [2, 3])
def test_each_model_is_compared_with_the_mean_of_the_others(scene, six, take_step, count):
    (term,) = LOSSES.make("co_regularization(0.6, lambda_dssim=0.3)")
    term.begin(scene)
    steps = joined(*(take_step(sh_dc=six.sh_dc + i * BRIGHTER) for i in range(count)))
    camera = term.draw(steps[0].generator("co_regularization"))
    images = [step.render(camera).image for step in steps]

    def loss(a, b):
        return 0.7 * np.abs(a.numpy() - b.numpy()).mean() + 0.3 * (1 - ssim(a, b))

    expected = sum(loss(a, b) for a in images for b in images if a is not b) / (count - 1)
    assert expected > 0.1
    assert term(steps[0]).item() == pytest.approx(0.6 * expected, rel=1e-9)
    assert [term(step).item() for step in steps[1:]] == [0.0] * (count - 1)
    assert not any(camera is observed for step in steps for _, observed in step.observed)


def test_every_model_learns_as_if_the_other_were_a_photograph(scene, six, take_step):
    """The loss is symmetric, so what a model is given is half of the derivative of the value."""
    (term,) = LOSSES.make("co_regularization")
    term.begin(scene)
    leaves = [(six.sh_dc + i * BRIGHTER).requires_grad_() for i in range(2)]

    def value(*sh_dc):
        return term(joined(*(take_step(sh_dc=x) for x in sh_dc))[0])

    found = torch.autograd.grad(value(*leaves), leaves)
    g = torch.Generator().manual_seed(3)
    for i, gradient in enumerate(found):
        direction = torch.randn(six.sh_dc.shape, generator=g, dtype=torch.float64)
        ends = [[x.detach() + h * direction * (k == i) for k, x in enumerate(leaves)] for h in (1e-6, -1e-6)]
        slope = (value(*ends[0]) - value(*ends[1])).item() / 2e-6
        assert abs(slope) > 1e-3
        assert (gradient * direction).sum().item() == pytest.approx(slope / 2, rel=1e-5)


def test_a_step_costs_one_more_render_of_every_model(tiny_scene):
    class Counting:
        capabilities, count = frozenset[str](), 0

        def __call__(self, **arguments):
            self.count += 1
            return render(**arguments)

    trainer = Trainer(tiny_scene, TrainConfig(iterations=4, loss="photometric + co_regularization", models=2))
    render, trainer.renderer = trainer.renderer, Counting()
    trainer.train_step()
    assert trainer.renderer.count == 4
    seen = [model.density.statistics.steps.max().item() for model in trainer.models]
    assert seen == [1, 1]


# The cameras


def literal(cameras, near, far, place):
    """The source's rule in camera-to-world matrices with y up and z backward, bounds at the first scaled to 4 / 3."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [np.linalg.inv(camera.world_to_camera.double().numpy()) @ flip for camera in cameras]
    scale = 1 / (0.75 * near)
    for pose in poses:
        pose[:3, 3] *= scale

    def looking(back, up, position):
        z = back / np.linalg.norm(back)
        x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
        pose = np.eye(4)
        pose[:3] = np.stack([x, np.cross(z, x), z, position], axis=1)
        return pose

    def mean(poses):
        return looking(*(np.mean([pose[:3, i] for pose in poses], axis=0) for i in (2, 1, 3)))

    average = mean(poses)
    poses = [np.linalg.inv(average) @ pose for pose in poses]
    radii = np.max([np.abs(pose[:3, 3]) for pose in poses], axis=0)
    focus = 1 / (0.25 / (0.9 * near * scale) + 0.75 / (5 * far * scale))
    position = (mean(poses) @ [*(radii * place), 1])[:3]
    back = position - (mean(poses) @ [0, 0, -focus, 1])[:3]
    pose = average @ looking(back, np.mean([pose[:3, 1] for pose in poses], axis=0), position)
    pose[:3, 3] /= scale
    return np.linalg.inv(pose @ flip)


@pytest.mark.parametrize("seed", range(4))
def test_cameras_are_placed_by_the_rule_of_the_source(tiny_scene, seed):
    cameras = [view.camera for view in tiny_scene.train]
    place = 2 * torch.rand(3, generator=torch.Generator().manual_seed(seed)).double().numpy() - 1
    place *= [1, -1, -1]  # the source's y is up and its z backward; the box is symmetric
    expected = literal(cameras, *depth_bounds(tiny_scene), place)
    found = pseudo_cameras(tiny_scene)(torch.Generator().manual_seed(seed))
    np.testing.assert_allclose(found.world_to_camera.numpy(), expected, atol=2e-6)
    assert (found.fx, found.cx, found.width) == (cameras[0].fx, 16, 32)


def test_bounds_are_those_of_all_points_but_two_in_a_thousand(tiny_scene):
    """Depths of 1 to 2 in steps of 0.001, and points that no picture holds."""
    camera = Camera(torch.eye(4), 10.0, 10.0, 5.0, 5.0, 10, 10)
    depths = torch.linspace(1, 2, 1001)
    points = torch.cat([torch.stack([0 * depths, 0 * depths, depths], 1), torch.tensor([[0, 0, -1.0], [9, 0, 1.0]])])
    view = dataclasses.replace(tiny_scene.train[0], camera=camera)
    scene = dataclasses.replace(tiny_scene, train=(view,), points=PointCloud(points, points, "hand"))
    assert depth_bounds(scene) == pytest.approx((1.001, 1.999), abs=1e-6)
    with pytest.raises(ValueError, match="no initial point"):
        depth_bounds(dataclasses.replace(scene, points=PointCloud(points[-2:], points[-2:], "hand")))


def test_cameras_around_an_object_are_refused(tiny_scene):
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    views = [
        dataclasses.replace(
            view, camera=dataclasses.replace(view.camera, world_to_camera=behind @ view.camera.world_to_camera)
        )
        for view in tiny_scene.train
    ]
    with pytest.raises(ValueError, match=r"axes is 0\.\d\d long"):
        pseudo_cameras(dataclasses.replace(tiny_scene, train=(*tiny_scene.train, *views)))
