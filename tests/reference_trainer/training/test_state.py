import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from reference_trainer.training.checkpoint import load_checkpoint, save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer, TrainingStoppedError

KEYS = ["config", "scene", "train_views", "step", "seconds", "statistics", "gaussians", "moments"]
Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def saved(tiny_scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("state") / "checkpoint.pt"
    trainer = Trainer(tiny_scene, TrainConfig(iterations=5))
    trainer.train(until=2)
    trainer.save(path)
    return path


def refused(saved: Path, scene: Any, tmp_path: Path, change: Change, said: str) -> None:
    state = load_checkpoint(saved)
    change(state)
    save_checkpoint(tmp_path / "checkpoint.pt", state)
    with pytest.raises(ValueError, match=rf"checkpoint\.pt.*{said}"):
        Trainer.load(tmp_path / "checkpoint.pt", scene)


@pytest.mark.parametrize("key", KEYS)
def test_a_missing_entry(saved, tiny_scene, tmp_path, key):
    refused(saved, tiny_scene, tmp_path, lambda state: state.pop(key), f"damaged checkpoint: it lacks '{key}'")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s["gaussians"].pop("sh_dc"), "missing 1 required positional argument: 'sh_dc'"),
        (lambda s: s["moments"].pop("means"), "it lacks 'means'"),
        (lambda s: s["moments"]["means"].pop("exp_avg"), "it lacks 'exp_avg'"),
        (lambda s: s["statistics"].pop("steps"), "missing 1 required positional argument: 'steps'"),
        (lambda s: s.update(step=2.0), "step must be a whole number from 0 to 5, got 2.0"),
        (lambda s: s.update(step=True), "step must be a whole number"),
        (lambda s: s.update(step=6), "step must be a whole number from 0 to 5, got 6"),
        (lambda s: s.update(seconds=math.nan), "seconds must be a positive number, got nan"),
        (lambda s: s.update(config="{"), "damaged checkpoint: Expecting"),
        (lambda s: s.update(config=3), "damaged checkpoint: "),
        (lambda s: s.update(config=json.dumps({"dropuot": 0.2})), r"unknown settings \['dropuot'\]"),
        (lambda s: s.update(config=json.dumps({"sh_degree": 1})), "step must be a whole|expected sh_degree 1, got 3"),
        (lambda s: s.update(gaussians=[1]), "damaged checkpoint: "),
        (lambda s: s.update(moments=3), "damaged checkpoint: "),
        (lambda s: s["gaussians"].update(means=3), "damaged checkpoint: "),
        (lambda s: s["gaussians"].update(means=torch.zeros(7, 3)), r"log_scales must have shape \(7, 3\)"),
        (lambda s: s["gaussians"].update(means=s["gaussians"]["means"].double()), "means: expected float32"),
        (lambda s: s["moments"]["means"].update(exp_avg=torch.zeros(3)), "exp_avg of means: expected float32 of shape"),
        (lambda s: s["statistics"].update(steps=torch.zeros(3)), r"steps: expected float32 of shape \(150,\)"),
        (lambda s: s["gaussians"]["means"].fill_(math.nan), "means: holds nan or infinity"),
        (lambda s: s["moments"]["sh_dc"]["exp_avg_sq"].fill_(math.inf), "exp_avg_sq of sh_dc: holds nan"),
    ],
)
def test_an_entry_that_does_not_fit(saved, tiny_scene, tmp_path, change, said):
    refused(saved, tiny_scene, tmp_path, change, said)


@pytest.mark.parametrize("name", ["means", "sh_rest"])
def test_a_model_that_is_not_finite_does_not_replace_one_that_is(tiny_scene, tmp_path, name):
    path = tmp_path / "checkpoint.pt"
    trainer = Trainer(tiny_scene, TrainConfig(iterations=5))
    trainer.save(path)
    before = path.read_bytes()
    trainer.train(until=2)
    with torch.no_grad():
        getattr(trainer.gaussians, name)[3] = math.nan
    with pytest.raises(TrainingStoppedError, match="nan or infinite by step 2, which is not saved: lower the learning"):
        trainer.save(path)
    assert path.read_bytes() == before
