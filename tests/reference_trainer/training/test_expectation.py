"""Analytic training: against sampled renders, enumeration, and itself."""

import dataclasses
import math
from itertools import product

import pytest
import torch
from oracles import random_scene

from ca_reg import Chain, GaussianDropout, OpacityNoise, Params
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians, render_moments_of
from reference_trainer.training.trainer import Trainer

BLACK = torch.zeros(3, dtype=torch.float64)


def expectation(gaussians, camera, chain):
    """What an analytic step renders."""
    x, multiplier = chain.alpha_factor(gaussians.params(camera))
    return render_moments_of(x, multiplier, camera, BLACK, sh_degree=0)[0]


def model(n: int, seed: int = 2) -> tuple[Gaussians, object]:
    scene = random_scene(n, 21, 15, seed=seed, size=0.3)
    gaussians = Gaussians.from_points(scene.means, scene.colors, scene.scales[:, 0], sh_degree=0)
    logits = torch.logit(0.2 + 0.6 * torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return dataclasses.replace(gaussians, opacity_logits=logits), scene.camera


@pytest.mark.parametrize(("p", "compensate"), [(0.3, False), (0.2, True), (0.5, True)])
def test_mean_variance_and_their_gradients_are_those_of_all_masks(p, compensate):
    """At 0.5 most survivors are clamped at 0.99, somewhere or everywhere; the gradient passes the clamp in both."""
    start, camera = model(6)
    chain = Chain(GaussianDropout(p, compensate=compensate))
    masks = torch.tensor(list(product([0.0, 1.0], repeat=6)), dtype=torch.float64)
    probability = (p + (1 - 2 * p) * masks).prod(1)
    found = []
    for enumerate_masks in (True, False):
        gaussians = start.map(lambda x: x.detach().clone().requires_grad_())
        if enumerate_masks:
            drawn = gaussians.opacities / (1 - p if compensate else 1)
            images = torch.stack(
                [render_gaussians(gaussians, camera, BLACK, opacities=drawn * mask).image for mask in masks]
            )
            mean = torch.einsum("k,kchw->chw", probability, images)
            variance = torch.einsum("k,kchw->chw", probability, (images - mean) ** 2)
        else:
            mean, variance, *_ = expectation(gaussians, camera, chain)
        (mean.square().sum() + 3 * variance.sum()).backward()
        found.append((mean, variance, *(x.grad for name, x in gaussians.named() if name != "sh_rest")))
    assert (found[0][1] > 1e-3).double().mean() > 0.1
    for enumerated, exact in zip(*found, strict=True):
        torch.testing.assert_close(exact, enumerated, rtol=1e-9, atol=1e-12)


def one_white(opacity: float) -> tuple[Gaussians, Camera]:
    """A white Gaussian that is centered on a pixel, so that its falloff there is 1; in the corner it is 0.73."""
    white = Gaussians.from_points(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.ones(1, 3), torch.tensor([1.2]), sh_degree=0, opacity=opacity
    )
    return white.map(lambda x: x.double()), Camera(torch.eye(4), 6.0, 6.0, 2.5, 2.5, 5, 5)


def test_opaque_gaussians_are_rendered_more_opaque_at_test_time_than_inverted_dropout_trains_them():
    """As docs/theory.md says; plain dropout has no such gap."""
    white, camera = one_white(0.95)
    for compensate, trained, drawn in ((True, 0.495, 0.95), (False, 0.475, 0.475)):
        chain = Chain(GaussianDropout(0.5, compensate=compensate))
        mean = expectation(white, camera, chain).mean[0, 2, 2].item()
        tested = render_gaussians(chain.expected(white.params(camera)), camera, BLACK).image
        assert (mean, tested[0, 2, 2].item()) == (pytest.approx(trained, rel=1e-6), pytest.approx(drawn, rel=1e-6))


@pytest.mark.parametrize("p", [0.0, 0.5])
def test_the_clamp_of_noisy_alphas_is_all_that_is_left_out(p):
    """Where a falloff exceeds 0.99 the noise reaches the clamp of alpha; it moves the mean by at most 1/99."""
    white, camera = one_white(0.95)
    chain = Chain(GaussianDropout(p, compensate=True), OpacityNoise(0.8))
    z, width = torch.linspace(-8, 8, 4001, dtype=torch.float64), 16 / 4000
    drawn = (0.95 / (1 - p) * (1 + 0.8 * z)).clamp(0, 1)
    levels, which = torch.unique((drawn * 100).round() / 100, return_inverse=True)
    weights = torch.zeros_like(levels).index_add_(0, which, width * torch.exp(-z * z / 2) / math.sqrt(2 * math.pi))
    images = torch.stack([render_gaussians(white, camera, BLACK, opacities=level[None]).image[0] for level in levels])
    mean = (1 - p) * torch.einsum("k,khw->hw", weights, images)
    error = expectation(white, camera, chain).mean[0] - mean
    assert 4e-4 < error.abs().max() < 1 / 99
    assert error[0, 0].abs() < 1e-4


def test_the_co_adaptation_term_is_the_weighted_mean_variance(tiny_scene, busy):
    """Of the step's own draws in an analytic step, of a dropout of its own in another."""
    plain = dataclasses.replace(busy, dropout=0.3, noise=0.0, analytic=True)
    losses = []
    for loss in ("photometric", "photometric + co_adaptation(3.0)", "co_adaptation(3.0)"):
        losses.append(Trainer(tiny_scene, dataclasses.replace(plain, loss=loss)).train_step())
    assert losses[1] - losses[0] == pytest.approx(losses[2], rel=1e-4)
    sampled = dataclasses.replace(plain, analytic=False, loss="co_adaptation(3.0, p=0.3)")
    assert Trainer(tiny_scene, sampled).train_step() == pytest.approx(losses[2], rel=1e-5)


def test_the_multiplier_is_that_of_what_training_samples():
    opacities = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    x, multiplier = Chain(GaussianDropout(0.2), OpacityNoise(0.6)).alpha_factor(Params(opacities))
    assert torch.equal(x.opacities, opacities)
    noise = OpacityNoise(0.6)
    generator = torch.Generator().manual_seed(0)
    n = 200_000
    repeated = opacities[:, None].expand(3, n).reshape(-1)
    keep = torch.rand(3, n, generator=generator) >= 0.2
    factors = (noise(repeated, generator=generator) / repeated).view(3, n) * keep
    # Standard errors are below 1/sqrt(200,000) = 0.22 % of a standard deviation of at most 0.75, and below 1 % of the
    # variance; five of them are passed by chance in less than one in a million of the six comparisons.
    torch.testing.assert_close(factors.mean(1), multiplier.mean, rtol=0, atol=5 * 0.75 * 0.0023)
    torch.testing.assert_close(factors.var(1), multiplier.variance, rtol=0.05, atol=0)


def test_training_lowers_the_loss_and_draws_nothing(tiny_scene, busy):
    config = dataclasses.replace(
        busy, iterations=12, dropout=0.2, noise=0.0, analytic=True, densify_every=0, opacity_reset_every=0
    )
    losses = []
    for _ in range(2):
        trainer = Trainer(tiny_scene, config)
        state = torch.random.get_rng_state()
        losses.append([trainer.train_step() for _ in range(12)])
        assert torch.equal(torch.random.get_rng_state(), state)
        assert trainer.regularizer.keep is None
    assert losses[0] == losses[1]
    views = len(tiny_scene.train)
    assert sum(losses[0][-views:]) < sum(losses[0][:views])


def test_before_the_regularizers_start_it_is_plain_training(tiny_scene, busy):
    plain = dataclasses.replace(busy, iterations=4, dropout=0.0, noise=0.0)
    late = dataclasses.replace(plain, dropout=0.2, analytic=True, regularize_from=3)
    one, other = Trainer(tiny_scene, plain), Trainer(tiny_scene, late)
    assert [one.train_step() for _ in range(3)] == [other.train_step() for _ in range(3)]
    assert one.train_step() != other.train_step()


def test_a_resumed_run_is_the_uninterrupted_one(tiny_scene, busy, tmp_path):
    config = dataclasses.replace(busy, iterations=14, dropout=0.2, noise=0.3, analytic=True)
    whole = Trainer(tiny_scene, config)
    whole.train(until=9)
    whole.save(tmp_path / "checkpoint.pt")
    resumed = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    whole.train()
    resumed.train()
    for (name, x), (_, y) in zip(whole.gaussians.named(), resumed.gaussians.named(), strict=True):
        assert torch.equal(x, y), name
