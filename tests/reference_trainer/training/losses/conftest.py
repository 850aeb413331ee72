"""A step of a model of six Gaussians in float64, with two more views beside its own."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from oracles import random_scene

from ca_reg import Chain
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render import render
from reference_trainer.scenes.scene import View
from reference_trainer.training.step import Step

BLACK = torch.zeros(3, dtype=torch.float64)


@pytest.fixture(scope="session")
def six() -> Gaussians:
    """Six elongated, rotated Gaussians that overlap in the view."""
    scene = random_scene(6, 25, 17, seed=2, size=0.4)
    gaussians = Gaussians.from_points(scene.means, scene.colors, scene.scales[:, 0], sh_degree=0)
    return dataclasses.replace(
        gaussians,
        log_scales=scene.scales.log(),
        quaternions=scene.quaternions,
        opacity_logits=torch.tensor([-0.5, 0.3, 1.0, 0.0, -2.5, 0.7], dtype=torch.float64),
    )


@pytest.fixture(scope="session")
def three_views() -> list[View]:
    """Three photographs of noise with depth priors and alpha, their cameras side by side."""
    camera, g = random_scene(6, 25, 17, seed=2).camera, torch.Generator().manual_seed(1)
    views = []
    for i, name in enumerate("abc"):
        pose = camera.world_to_camera.clone()
        pose[0, 3] += 0.1 * i
        image, prior = (torch.rand(n, 17, 25, generator=g, dtype=torch.float64) for n in (3, 1))
        alpha = (torch.rand(17, 25, generator=g) < 0.4).double()
        moved = dataclasses.replace(camera, world_to_camera=pose)
        views.append(View(name, moved, image, alpha, depth_prior=prior[0]))
    return views


@pytest.fixture(scope="session")
def take_step(six, three_views) -> Callable[..., Step]:
    """Render the first view with what is given in the place of the six Gaussians' own parameters."""

    def taken(*, number: int = 5, seed: int = 0, depth: bool = True, regularizer: Chain | None = None, **raw) -> Step:
        chain = Chain() if regularizer is None else regularizer
        gaussians = dataclasses.replace(six, **raw)
        options = {"photographed_over": BLACK, "sh_degree": 0, "seed": seed, "renderer": render}
        step = Step(number, three_views[0], three_views, gaussians, chain, BLACK, **options)
        step.sample(depth=depth)
        return step

    return taken


@pytest.fixture(scope="session")
def assert_gradients_of_differences(six, take_step) -> Callable[..., None]:
    """Compare a term's gradients in raw parameters, through the renderer, with float64 differences on random lines."""

    def check(term, *names: str, seed: int = 0) -> None:
        def loss(*leaves):
            return term(take_step(seed=seed, **dict(zip(names, leaves, strict=True))))

        leaves = [getattr(six, name).clone().requires_grad_() for name in names]
        assert any(gradient.abs().max() > 1e-6 for gradient in torch.autograd.grad(loss(*leaves), leaves))
        assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)

    return check
