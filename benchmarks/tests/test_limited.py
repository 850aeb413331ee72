"""The limit of the seventeenth choice, against distances by hand."""

import torch

from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def test_no_gaussian_is_larger_than_its_share_of_the_distance_to_the_nearest_camera():
    scene = synthetic_scene(width=32, height=24, points=100)
    config = TrainConfig(iterations=3, density="benchmarks.limited:LimitedDensity(0.02)")
    trainer = Trainer(scene, config)
    assert (trainer.gaussians.scales.amax(1) > 0.05 * nearest(trainer.gaussians.means, scene)).any()
    trainer.density.before_step(trainer.optimizer, 0)
    limits = 0.02 * nearest(trainer.gaussians.means, scene)
    torch.testing.assert_close(trainer.gaussians.scales.amax(1).minimum(limits), trainer.gaussians.scales.amax(1))
    trainer.train()
    assert (trainer.gaussians.scales.amax(1) <= 1.1 * 0.02 * nearest(trainer.gaussians.means, scene)).all()


def nearest(means, scene):
    """The distance of every Gaussian to the nearest training camera."""
    apart = [(means.detach() - view.camera.position).square().sum(1).sqrt() for view in scene.train]
    return torch.stack(apart).amin(0)
