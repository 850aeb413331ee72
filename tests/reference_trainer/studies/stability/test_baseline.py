"""The frozen baseline is brute force."""

import dataclasses

import pytest
import torch
from oracles import brute_force, random_scene

from reference_trainer.studies.stability.quantities import render_simply


@pytest.mark.parametrize("size", [0.03, 0.4])  # the larger ones are opaque: the early stop and the clamp matter
def test_values_and_gradients_are_those_of_brute_force(size):
    scene = random_scene(60, 37, 21, 3, size=size)
    weights = torch.rand(3, 21, 37, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for render_fn in (render_simply, lambda *x: brute_force(*x)[0]):
        leaves = [x.clone().requires_grad_() for x in scene.tensors()]
        image = render_fn(*leaves, scene.camera)
        results.append((image.detach(), *torch.autograd.grad((image * weights).sum(), leaves)))
    for found, true in zip(*results, strict=True):
        assert float(true.abs().max()) > 0
        assert torch.allclose(found, true, rtol=1e-9, atol=1e-11 * float(true.abs().max()))


def test_it_is_differentiable_where_nothing_is_seen(device):
    scene = random_scene(6, 20, 18, 0).to(torch.float32, device)
    turned = dataclasses.replace(scene.camera, world_to_camera=torch.diag(torch.tensor([-1.0, 1, -1, 1])).to(device))
    behind = scene._replace(means=scene.means.abs(), camera=turned)
    means = behind.means.requires_grad_()
    image = render_simply(*behind.tensors(), behind.camera)
    assert torch.equal(image, torch.zeros(3, 18, 20, device=device))
    assert torch.equal(torch.autograd.grad(image.sum(), means)[0], torch.zeros_like(means))
