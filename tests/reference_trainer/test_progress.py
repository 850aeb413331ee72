"""Progress bars, where a terminal shows them and where none does."""

import logging

import pytest

from reference_trainer import cli
from reference_trainer.progress import progress_bar
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


def test_a_message_does_not_go_into_the_line_of_a_bar(monkeypatch, capsys):
    """The bar is wiped out for it, and drawn again below."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with cli.log_shown(), progress_bar(total=3, bar_format="{n} of {total}") as bar:
        bar.update()
        bar.refresh()
        before = capsys.readouterr().err
        logging.getLogger("reference_trainer.training").info("2 Gaussians removed")
        said, after = capsys.readouterr()
    assert before.endswith("1 of 3")
    assert said == "2 Gaussians removed\n"
    wiped, drawn = after.rsplit("\r", 1)
    assert not wiped.strip()
    assert drawn.rstrip() == "1 of 3"
