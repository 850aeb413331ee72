"""Progress bars, where a terminal shows them and where none does."""

import pytest

from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


@pytest.mark.parametrize("terminal", [False, True])
def test_a_training_writes_little_where_no_terminal_shows_its_bar(terminal, monkeypatch, capsys):
    scene = synthetic_scene(width=8, height=6, points=20)
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal)
    Trainer(scene, TrainConfig(iterations=60)).train(progress=True)
    error = capsys.readouterr().err
    assert "60/60" in error  # the last one always shows
    if not terminal:
        assert error.count("60 [") <= 2  # the first and the last, within a minute
