"""A finished run, and a scene with masks for what measures quality."""

import dataclasses
from pathlib import Path

import pytest
import torch

from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions


@pytest.fixture(scope="module")
def finished(tmp_path_factory, options, short) -> tuple[Path, dict]:
    """The folder of a run, which must be copied before it is changed, and its results."""
    out = tmp_path_factory.mktemp("run")
    return out, run_experiment(options, short, out, monitoring=Monitoring(3, pictures=True, checkpoint_every=4))


@pytest.fixture
def masked(options, monkeypatch) -> SceneOptions:
    """Options whose scene has masks: of every photograph the left half counts, and the right half is noise."""
    scene, generator = load_scene(options), torch.Generator().manual_seed(0)

    def half(view):
        mask = torch.zeros_like(view.image[0])
        mask[:, : mask.shape[1] // 2] = 1
        noise = torch.rand(view.image.shape, generator=generator).round()
        return dataclasses.replace(view, image=view.image.where(mask > 0, noise), mask=mask)

    scene = dataclasses.replace(scene, train=tuple(map(half, scene.train)), test=tuple(map(half, scene.test)))
    for module in ("run", "ply"):
        monkeypatch.setattr(f"reference_trainer.runs.{module}.load_scene", lambda *_, **__: scene)
    return options
