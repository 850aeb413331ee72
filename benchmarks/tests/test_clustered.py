"""Masks that drop neighbors together, beside independent ones."""

import pytest

from benchmarks import clustered
from reference_trainer.runs.run import model_of
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def test_the_independent_variance_is_the_exact_score_and_clusters_vary_more(tiny_scene, tmp_path, monkeypatch):
    """Of an untrained, opaque model; holes of eleven neighbors show more than single ones."""
    trainer = Trainer(tiny_scene, TrainConfig(initial_opacity=0.9))
    monkeypatch.setattr(clustered, "load_run", lambda run: trainer)
    found = clustered.measure(tmp_path, samples=64)
    score = model_of(trainer).exact_ca_score(drop_rate=0.5)
    exact = [score(trainer.gaussians.opacities.detach(), view).value for view in tiny_scene.test]
    assert found["independent"] == pytest.approx(sum(exact) / len(exact), rel=1e-6)
    assert found["ratio"] == pytest.approx(found["clustered"] / found["independent"])
    assert found["ratio"] > 1.1
    assert clustered.table({"one": [found], "other": [found, found]}).count("\n") == 4
