"""Analytic training: against sampled renders, enumeration, and itself."""

import dataclasses
from itertools import product

import pytest
import torch
from oracles import random_scene

from ca_reg import OpacityNoise
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.expectation import expected_draw, render_expectation
from reference_trainer.training.trainer import Trainer

BLACK = torch.zeros(3, dtype=torch.float64)


def model(n: int, seed: int = 2) -> tuple[Gaussians, object]:
    scene = random_scene(n, 21, 15, seed=seed, size=0.3)
    gaussians = Gaussians.from_points(scene.means, scene.colors, scene.scales[:, 0], sh_degree=0)
    logits = torch.logit(0.2 + 0.6 * torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return dataclasses.replace(gaussians, opacity_logits=logits), scene.camera


def test_the_render_is_the_enumerated_mean_and_variance():
    gaussians, camera = model(7)
    masks = torch.tensor(list(product([0.0, 1.0], repeat=7)), dtype=torch.float64)
    probability = (0.3 + 0.4 * masks).prod(1)
    images = torch.stack(
        [render_gaussians(gaussians, camera, BLACK, opacities=gaussians.opacities * mask).image for mask in masks]
    )
    mean = torch.einsum("k,kchw->chw", probability, images)
    variance = torch.einsum("k,kchw->chw", probability, (images - mean) ** 2)
    out = render_expectation(gaussians, camera, BLACK, TrainConfig(dropout=0.3, analytic=True), sh_degree=0)
    torch.testing.assert_close(out.image, mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(out.variance, variance, rtol=0, atol=1e-12)
    assert out.penalty.item() == 0


def test_the_penalty_is_the_weighted_mean_variance():
    gaussians, camera = model(9)
    config = TrainConfig(dropout=0.3, analytic=True, ca_weight=3.0)
    out = render_expectation(gaussians, camera, BLACK, config, sh_degree=0)
    assert out.penalty.item() == pytest.approx(3 * out.variance.mean().item(), rel=1e-12)


def test_the_multiplier_is_that_of_what_training_samples():
    opacities = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    config = TrainConfig(dropout=0.2, noise=0.6, analytic=True)
    rendered, multiplier = expected_draw(config, opacities)
    assert torch.equal(rendered, opacities)
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
        losses.append([trainer.train_step()[0] for _ in range(12)])
        assert torch.equal(torch.random.get_rng_state(), state)
        assert trainer.dropout.keep is None
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
