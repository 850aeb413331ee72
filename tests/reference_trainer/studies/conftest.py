"""Runs of seconds: the built-in scene at 20 x 15 pixels, a dozen steps."""

import dataclasses

import pytest

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.run import run_experiment
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


@pytest.fixture(scope="session")
def run(tmp_path_factory, options, short):
    out = tmp_path_factory.mktemp("run")
    return out, run_experiment(options, short, out, monitor_every=0)


@pytest.fixture(scope="session")
def scaled(tmp_path_factory, options, short):
    """The same training, evaluated with opacities times the mean of their noise."""
    out = tmp_path_factory.mktemp("scaled")
    return out, run_experiment(options, dataclasses.replace(short, scale_noise=True), out, monitor_every=11)
