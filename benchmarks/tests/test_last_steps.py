"""Means over last steps: against a recording of every step, and the page."""

from __future__ import annotations

import json

import torch
from pages import lines_missing

from benchmarks import last_steps, setting
from benchmarks.last_steps import Means, table
from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def test_a_mean_is_that_of_the_last_steps():
    trainer = Trainer(synthetic_scene(width=16, height=12, points=20), TrainConfig(iterations=5))
    means, steps = Means(5, (1, 3)), []

    def after_step(trainer):
        means(trainer)
        steps.append({name: x.detach().clone() for name, x in trainer.gaussians.named()})

    trainer.train(after_step=after_step)
    for window in (1, 3):
        for name, x in means.of(window).named():
            torch.testing.assert_close(x, torch.stack([step[name] for step in steps[-window:]]).mean(0))


def test_a_gain_is_over_the_last_step_of_the_same_training():
    names = [f"{begin}{window}" for begin, windows in last_steps.WINDOWS.items() for window in windows]
    rows = [
        {"scene": scene, "seed": seed}
        | {name: {"test": seed + gain * (name == "50"), "held-out": 10.0 + seed} for name in names}
        for scene, gain in (("fern", 0.5), ("synthetic", 9.0))
        for seed in (3, 4)
    ]
    lines = {
        cells[1].strip(): [x.strip() for x in cells[2:-1]] for cells in (x.split("|") for x in table(rows).splitlines())
    }
    assert lines["mean over 50"] == ["+0.00 / +9.00", "+0.00 / +0.50", "+0.00 / +0.50"]
    assert lines["mean over 100"] == ["+0.00 / +0.00"] * 3
    assert len(lines) == 2 + len(names) - 1


def test_the_page_has_the_table_of_its_rows():
    rows = json.loads((setting.REFERENCES.parent / "last_steps.json").read_text("utf-8"))
    assert lines_missing(table(rows), "choices.md") == []
