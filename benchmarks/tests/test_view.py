"""The viewer's benchmark runs."""

import re

import pytest

from reference_trainer.scenes import load_scene
from reference_trainer.training.trainer import Trainer


def test_the_pictures_of_a_measurement_are_timed_beside_a_step(options, short, capsys):
    for extra in ("viser", "tensorboard"):
        pytest.importorskip(extra)
    from benchmarks import view

    view.pictures(Trainer(load_scene(options), short))
    assert re.search(r"pictures [1-9]\d* ms, [\d.]+ steps' time", capsys.readouterr().out)
