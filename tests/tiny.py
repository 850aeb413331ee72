"""Tiny scenes and schedules of seconds, for everything that trains."""

from pathlib import Path

import pytest

from ca_reg.neighbors import rms_neighbor_distance
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import save_ply
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    """The built-in scene at 32 x 24 pixels with 150 points; a step takes a few milliseconds."""
    return synthetic_scene(width=32, height=24, points=150)


@pytest.fixture(scope="session")
def busy() -> TrainConfig:
    """A short schedule in which everything happens: dropout, noise, splits, clones, pruning, resets, all SH bands."""
    return TrainConfig(
        iterations=24,
        dropout=0.2,
        noise=0.4,
        sh_every=5,
        means_rate=1e-3,
        densify_from=3,
        densify_every=4,
        densify_gradient=1e-4,
        dense_fraction=0.12,
        prune_opacity=0.02,
        prune_size=0.1,
        prune_size_from=9,
        opacity_reset_from=10,
        opacity_reset_every=9,
    )


@pytest.fixture(scope="session")
def options() -> SceneOptions:
    """The built-in scene at 20 x 15 pixels."""
    return SceneOptions("synthetic", downscale=8)


@pytest.fixture(scope="session")
def short() -> TrainConfig:
    """Eleven steps with splits, dropout and noise; measurements and checkpoints do not fall together."""
    return TrainConfig(
        iterations=11, dropout=0.2, noise=0.3, sh_every=4, densify_from=2, densify_every=4, densify_gradient=2e-3
    )


def save_few(path: Path) -> None:
    """Save a start for `--init` from a tenth of the built-in scene's points.

    What an engine in torch computes grows with the longest list, and on the pretended card every operation costs.
    """
    points = synthetic_scene(width=20, height=15).points
    places, colors = points.positions[::10], points.colors[::10]
    save_ply(Gaussians.from_points(places, colors, rms_neighbor_distance(places), sh_degree=0, opacity=0.5), path)
