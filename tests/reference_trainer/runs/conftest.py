"""A scene with masks, for what measures quality."""

import dataclasses

import pytest
import torch

from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions


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
    monkeypatch.setattr("reference_trainer.scenes.load._load", lambda *_: scene)
    return options
