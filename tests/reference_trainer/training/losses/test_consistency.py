"""DropoutGS's consistency against the enumeration of all masks, kornia's SSIM, and differences."""

import dataclasses
from itertools import product

import pytest
import torch
from oracles import random_scene

from ca_reg import Chain, GaussianDropout
from reference_trainer.evaluation.metrics import ssim
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render import render
from reference_trainer.scenes.scene import View
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES, Consistency
from reference_trainer.training.step import Step
from reference_trainer.training.trainer import Trainer

BLACK = torch.zeros(3, dtype=torch.float64)


def four() -> tuple[Gaussians, View]:
    """Four Gaussians that overlap, in float64, and a view of them."""
    scene = random_scene(4, 21, 15, seed=2, size=0.3)
    gaussians = Gaussians.from_points(scene.means, scene.colors, scene.scales[:, 0], sh_degree=0)
    logits = torch.tensor([-0.5, 0.3, 1.0, 0.0], dtype=torch.float64)
    image = torch.rand(3, 15, 21, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return dataclasses.replace(gaussians, opacity_logits=logits), View("a", scene.camera, image)


def step_of(gaussians: Gaussians, view: View, *, seed: int = 0, regularizer: Chain | None = None) -> Step:
    chain = Chain() if regularizer is None else regularizer
    options = {"photographed_over": BLACK, "sh_degree": 0, "seed": seed, "renderer": render}
    step = Step(5, view, [view], gaussians, chain, BLACK, **options)
    step.sample(depth=False)
    return step


def images_of_all_masks(gaussians: Gaussians, view: View) -> dict[tuple[float, ...], torch.Tensor]:
    masks = list(product([0.0, 1.0], repeat=4))
    drawn = (gaussians.opacities * torch.tensor(mask, dtype=torch.float64) for mask in masks)
    return {
        mask: render_gaussians(gaussians, view.camera, BLACK, opacities=opacities).image
        for mask, opacities in zip(masks, drawn, strict=True)
    }


def test_the_exact_form_is_the_mean_squared_error_over_all_masks_with_its_gradient():
    start, view = four()
    p, found = 0.4, []
    for enumerate_masks in (True, False):
        gaussians = start.map(lambda x: x.detach().clone().requires_grad_())
        if enumerate_masks:
            full = render_gaussians(gaussians, view.camera, BLACK).image
            images = images_of_all_masks(gaussians, view)
            loss = 0.7 * sum(
                (1 - p) ** sum(mask) * p ** (4 - sum(mask)) * (image - full).square().mean()
                for mask, image in images.items()
            )
        else:
            loss = Consistency(p, 0.7, exact=True)(step_of(gaussians, view))
        loss.backward()
        found.append((loss, *(x.grad for name, x in gaussians.named() if name != "sh_rest")))
    assert found[0][0] > 1e-3
    for enumerated, exact in zip(*found, strict=True):
        torch.testing.assert_close(exact, enumerated, rtol=1e-9, atol=1e-12)


def test_the_sampled_form_is_l1_and_dssim_to_the_render_of_one_mask():
    gaussians, view = four()
    images, seen = images_of_all_masks(gaussians, view), set()
    full = render_gaussians(gaussians, view.camera, BLACK).image
    term = Consistency(0.4, 0.5, 0.3)
    for seed in range(12):
        step = step_of(gaussians, view, seed=seed)
        loss = term(step)
        assert torch.equal(loss, term(step)), "the draw is the step's, not the global one"
        mask = tuple(term.dropout.keep.double().tolist())
        seen.add(mask)
        literal = 0.5 * (0.7 * (full - images[mask]).abs().mean() + 0.3 * (1 - ssim(full, images[mask])))
        torch.testing.assert_close(loss, literal, rtol=1e-6, atol=1e-12)
    assert len(seen) > 4


@pytest.mark.slow
def test_the_mean_of_sampled_squared_errors_is_the_exact_form():
    """Through the masks that the term draws: 400 of them within 4.5 standard errors, false in 1 of 100,000 seeds."""
    gaussians, view = four()
    images, term = images_of_all_masks(gaussians, view), Consistency(0.4, 1.0)
    full = images[1.0, 1.0, 1.0, 1.0]
    errors = []
    for seed in range(400):
        step = step_of(gaussians, view, seed=seed)
        term.dropout.regularize(step.params, step.generator("consistency"))
        errors.append((images[tuple(term.dropout.keep.double().tolist())] - full).square().mean())
    errors = torch.stack(errors)
    exact = Consistency(0.4, 1.0, exact=True)(step_of(gaussians, view))
    assert abs(errors.mean() - exact) < 4.5 * errors.std() / 20


@pytest.mark.parametrize("exact", [False, True])
def test_gradients_are_those_of_differences(exact):
    """Of both renders: a detached one would lack its half."""
    start, view = four()
    term = Consistency(0.4, 1.0, 0.3, exact=exact)

    def loss(logits, colors):
        return term(step_of(dataclasses.replace(start, opacity_logits=logits, sh_dc=colors), view, seed=3))

    leaves = [x.clone().requires_grad_() for x in (start.opacity_logits, start.sh_dc)]
    assert torch.autograd.gradcheck(loss, leaves, eps=1e-6, atol=1e-7, rtol=1e-4)


@pytest.mark.parametrize("exact", [False, True])
def test_the_full_render_is_the_plain_one_whatever_regularizes_the_step(exact):
    gaussians, view = four()
    term = Consistency(0.4, 1.0, exact=exact)
    plain = term(step_of(gaussians, view))
    regularized = step_of(gaussians, view, regularizer=Chain(GaussianDropout(0.9)))
    torch.testing.assert_close(term(regularized), plain)
    assert len(regularized.observed) == 1, "density control sees the render of the step alone"


def test_it_does_not_act_without_weight_or_rate():
    for term in (Consistency(0.0), Consistency(0.4, 0.0), Consistency(0.0, exact=True)):
        assert not term.acts(0)
    assert Consistency(0.4).acts(0)


def test_the_exact_form_needs_moments_of_the_renderer():
    for exact in (False, True):
        assert Consistency(exact=exact).needs == ({"moments"} if exact else set())
    with pytest.raises(ValueError, match=r"loss .*moments, .*gsplat"):
        check(TrainConfig(loss="photometric + consistency(0.3, exact=True)", renderer="gsplat"))


def test_arguments():
    for text, message in (
        ("consistency(1.0)", r"p must be in \[0, 1\)"),
        ("consistency(0.4, -1.0)", "weight must not be negative"),
        ("consistency(0.4, 1.0, 2.0)", "lambda_dssim must lie"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
    (term,) = LOSSES.make("consistency")
    assert (term.p, term.weight, term.exact) == (0.4, 0.2, False)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"dropout": 0.2}, {"dropout": 0.2, "analytic": True}])
@pytest.mark.parametrize("exact", [False, True])
def test_it_trains_with_and_without_regularizers(tiny_scene, changes, exact):
    loss = f"photometric(0.2) + consistency(0.3, 0.5, exact={exact})"
    trainers = [Trainer(tiny_scene, TrainConfig(iterations=4, loss=text, **changes)) for text in ("photometric", loss)]
    for trainer in trainers:
        trainer.train()
    assert not torch.equal(*(trainer.gaussians.opacity_logits for trainer in trainers))
