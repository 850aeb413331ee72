"""Runs of seconds: the built-in scene at 20 x 15 pixels, a dozen steps."""

import pytest

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig


@pytest.fixture(scope="session")
def options() -> SceneOptions:
    return SceneOptions("synthetic", downscale=8)


@pytest.fixture(scope="session")
def short() -> TrainConfig:
    """Eleven steps with splits, dropout and noise; measurements and checkpoints do not fall together."""
    return TrainConfig(
        iterations=11, dropout=0.2, noise=0.3, sh_every=4, densify_from=2, densify_every=4, densify_gradient=2e-3
    )
