"""Runs of seconds, for everything that trains."""

import dataclasses
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest
from heard import hearing
from tiny import busy as busy
from tiny import options as options
from tiny import short as short
from tiny import tiny_scene as tiny_scene

from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.training.interruption import TrainingInterrupted
from reference_trainer.training.trainer import Trainer


@pytest.fixture
def said() -> Iterator[list[str]]:
    """What the trainer says while a test runs."""
    with hearing() as messages:
        yield messages


@pytest.fixture
def ctrl_c(monkeypatch) -> Callable[[int], AbstractContextManager[None]]:
    """A context in which somebody presses Ctrl-C at a step of every training, and the training says so at its end."""
    original = Trainer.train_step

    @contextmanager
    def pressed_at(step: int) -> Iterator[None]:
        def train_step(trainer: Trainer) -> float:
            if trainer.step == step:
                signal.raise_signal(signal.SIGINT)
            return original(trainer)

        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "train_step", train_step)
            with pytest.raises(TrainingInterrupted):
                yield

    return pressed_at


@pytest.fixture(scope="session")
def run(tmp_path_factory, options, short):
    """The folder of a finished run of seconds, and its results."""
    out = tmp_path_factory.mktemp("run")
    return out, run_experiment(options, short, out, monitoring=Monitoring(0))


@pytest.fixture(scope="session")
def scaled(tmp_path_factory, options, short):
    """The same training, evaluated with opacities times the mean of their noise."""
    out = tmp_path_factory.mktemp("scaled")
    return out, run_experiment(
        options, dataclasses.replace(short, noise=0.0, regularizer="noise(0.3, scale=True)"), out
    )  # measured at its end
