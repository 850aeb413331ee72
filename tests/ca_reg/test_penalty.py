"""The noise-free penalty, against training with every mask there is: the value of the loss and its gradients."""

import itertools

import numpy as np
import pytest
import torch
from oracles import random_scene
from torch.nn.functional import mse_loss

from ca_reg import CAPenalty
from ca_reg.functional import Multiplier, alpha_moments, expected_squared_error, pixel_moments, scale_opacity
from ca_reg.schedules import Constant, LinearRamp
from reference_trainer.render import render, splat
from reference_trainer.render.renderer import render_moments

HEIGHT, WIDTH = 3, 4
BACKGROUND = torch.tensor([0.9, 0.1, 0.4], dtype=torch.float64)


class Cloud:
    """Gaussians in a fixed order over a picture: falloffs (H, W, n) at most 1, and colors (n, 3)."""

    def __init__(self, n, seed=0, dtype=torch.float64):
        g = torch.Generator().manual_seed(seed)
        self.falloff = torch.rand(HEIGHT, WIDTH, n, generator=g, dtype=dtype)
        self.falloff[0, 0, 0] = 1.0
        self.opacity = 0.05 + 0.9 * torch.rand(n, generator=g, dtype=dtype)
        self.opacity[0] = 0.999  # clamped in a pixel: a factor of 0 or 1 commutes with the clamp
        self.colors = torch.rand(n, 3, generator=g, dtype=dtype)
        self.target = torch.rand(3, HEIGHT, WIDTH, generator=g, dtype=dtype)

    def alphas(self, opacity):
        return (opacity.reshape(-1) * self.falloff).clamp(max=0.99)

    def composite(self, alphas, colors, background=BACKGROUND):
        """Front to back from the definition, (3, H, W)."""
        light, image = torch.ones_like(alphas[..., 0]), 0.0
        for i in range(alphas.shape[-1]):
            image = image + alphas[..., i] * light * colors[i, :, None, None]
            light = light * (1 - alphas[..., i])
        return image + light * background[:, None, None]

    def moments(self, opacity, colors, multiplier, background):
        alphas = self.alphas(opacity)
        expanded = colors.expand(*alphas.shape, 3)
        behind = BACKGROUND.to(alphas) if background is None else background
        mean, variance = pixel_moments(alphas, expanded, multiplier, background=behind)
        images = {"mean": mean.permute(2, 0, 1), "variance": variance.permute(2, 0, 1)}
        return images | {"alpha_mean": alpha_moments(alphas, multiplier).mean}


def bernoulli(p, scale=1.0):
    return (0.0, scale), (p, 1 - p)


def gauss_hermite(sigma):
    # The squared error is of degree 2 in each factor: three nodes are exact.
    x, w = np.polynomial.hermite_e.hermegauss(3)
    return 1 + sigma * x, w / w.sum()


@pytest.mark.parametrize(
    ("n", "multiplier", "support"),
    [
        (1, Multiplier.dropout(0.2), bernoulli(0.2)),
        (8, Multiplier.dropout(0.2), bernoulli(0.2)),
        (6, Multiplier.dropout(0.6), bernoulli(0.6)),
        (5, Multiplier.dropout(0.3, compensate=True), bernoulli(0.3, 1 / 0.7)),
        (4, Multiplier.opacity_noise(0.8), gauss_hermite(0.8)),
    ],
)
def test_it_is_training_with_random_factors_without_the_noise(n, multiplier, support):
    cloud = Cloud(n, seed=n)
    leaves = [x.clone().requires_grad_() for x in (cloud.opacity, cloud.colors)]
    expected, gradients = 0.0, [torch.zeros_like(x) for x in leaves]
    for draw in itertools.product(*[list(zip(*support, strict=True))] * n):
        factors = torch.tensor([value for value, _ in draw], dtype=torch.float64)
        probability = float(np.prod([weight for _, weight in draw]))
        loss = mse_loss(cloud.composite(factors * cloud.alphas(leaves[0]), leaves[1]), cloud.target)
        expected += probability * loss.item()
        for total, gradient in zip(gradients, torch.autograd.grad(loss, leaves), strict=True):
            total += probability * gradient
    image, variance, penalty = CAPenalty(cloud.moments, multiplier)(leaves[0], leaves[1])
    loss = mse_loss(image, cloud.target) + penalty
    assert loss.item() == pytest.approx(expected, rel=1e-12)
    assert expected_squared_error(image, variance, cloud.target).mean().item() == pytest.approx(expected, rel=1e-12)
    for gradient, average in zip(torch.autograd.grad(loss, leaves), gradients, strict=True):
        assert average.abs().max() > 1e-3
        torch.testing.assert_close(gradient, average, rtol=1e-10, atol=1e-14)


def test_it_is_training_with_dropout_through_the_reference_renderer():
    scene = random_scene(6, 13, 9, seed=17, size=0.35)
    target = torch.rand(3, 9, 13, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    means, opacity, colors = leaves = [
        x.clone().requires_grad_() for x in (scene.means, 0.1 + 0.5 * scene.opacities, scene.colors)
    ]

    def moments_fn(opacity, camera, multiplier, background):
        splats = splat(means, scene.quaternions, scene.scales, opacity, camera, colors=colors)
        return render_moments(splats, multiplier, background=background)

    total = torch.tensor(0.0, dtype=torch.float64)
    for bits in itertools.product([0.0, 1.0], repeat=6):
        mask = torch.tensor(bits, dtype=torch.float64)
        out = render(
            means, scene.quaternions, scene.scales, opacity * mask, scene.camera, colors=colors, background=BACKGROUND
        )
        total = total + (0.3 ** (1 - mask) * 0.7**mask).prod() * mse_loss(out.image, target)
    image, _, penalty = CAPenalty(moments_fn, Multiplier.dropout(0.3))(opacity, scene.camera, BACKGROUND)
    loss = mse_loss(image, target) + penalty
    torch.testing.assert_close(loss, total, rtol=1e-12, atol=0)
    for gradient, average in zip(torch.autograd.grad(loss, leaves), torch.autograd.grad(total, leaves), strict=True):
        torch.testing.assert_close(gradient, average, rtol=1e-10, atol=1e-14)


def test_all_outputs_are_differentiable():
    cloud = Cloud(4)
    cloud.opacity[0] = 0.9

    def outputs(opacity, colors):
        noise = CAPenalty(cloud.moments, lambda o: Multiplier.clamped_noise(o, 0.8), weight=0.7)
        return (*CAPenalty(cloud.moments, Multiplier.dropout(0.3))(opacity, colors), noise(opacity, colors).penalty)

    assert torch.autograd.gradcheck(outputs, (cloud.opacity.requires_grad_(), cloud.colors.requires_grad_()))


def test_the_image_is_the_scaled_render_and_the_clamp_moves_it_by_at_most_one_99th():
    worst = 0.0
    for seed, p in itertools.product(range(20), (0.0, 0.2, 0.6, 0.9)):
        cloud = Cloud(12, seed)
        cloud.falloff[1:] = cloud.falloff[1:].sqrt().sqrt()
        cloud.opacity[1:] = 1.0
        image = CAPenalty(cloud.moments, Multiplier.dropout(p))(cloud.opacity, cloud.colors).image
        scaled = cloud.composite(cloud.alphas(scale_opacity(cloud.opacity, p)), cloud.colors)
        clamped = (cloud.opacity * cloud.falloff > 0.99).any(-1)
        torch.testing.assert_close(image[:, ~clamped], scaled[:, ~clamped], rtol=1e-12, atol=1e-14)
        worst = max(worst, (image - scaled)[:, clamped].abs().max().item())
    assert 1e-3 < worst <= 1 / 99


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_shapes_dtype_and_layout(dtype, shape):
    cloud = Cloud(5, dtype=dtype)
    dropout = Multiplier.dropout(0.2)
    image, variance, penalty = CAPenalty(cloud.moments, dropout)(cloud.opacity.reshape(shape), cloud.colors)
    assert image.shape == variance.shape == (3, HEIGHT, WIDTH)
    assert image.dtype == variance.dtype == penalty.dtype == dtype
    assert penalty.ndim == 0
    assert penalty == variance.mean() > 0

    def hwc(*arguments):
        return {k: x.permute(1, 2, 0) if x.ndim == 3 else x for k, x in cloud.moments(*arguments).items()}

    turned = CAPenalty(hwc, dropout, layout="HWC")(cloud.opacity, cloud.colors)
    assert torch.equal(turned.image, image)
    assert torch.equal(turned.variance, variance)


def test_the_view_and_the_background_are_passed_on():
    cloud = Cloud(5)
    penalty = CAPenalty(cloud.moments, Multiplier.dropout(0.2))
    white = penalty(cloud.opacity, cloud.colors, torch.ones(3, dtype=torch.float64))
    expected = cloud.moments(cloud.opacity, cloud.colors, Multiplier.dropout(0.2), torch.ones(3, dtype=torch.float64))
    assert torch.equal(white.image, expected["mean"])
    assert torch.equal(white.variance, expected["variance"])
    assert not torch.equal(white.variance, penalty(cloud.opacity, cloud.colors).variance)


@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_a_multiplier_that_depends_on_the_opacity_is_made_at_every_call(shape):
    cloud = Cloud(5)
    penalty = CAPenalty(cloud.moments, lambda o: Multiplier.clamped_noise(o, 0.8))
    for opacity in (cloud.opacity, 0.5 * cloud.opacity):
        fixed = CAPenalty(cloud.moments, Multiplier.clamped_noise(opacity, 0.8))(opacity, cloud.colors)
        result = penalty(opacity.reshape(shape), cloud.colors)
        assert torch.equal(result.image, fixed.image)
        assert torch.equal(result.variance, fixed.variance)


def test_the_weight_multiplies_the_penalty_only_and_follows_the_step():
    cloud = Cloud(5)
    penalty = CAPenalty(cloud.moments, Multiplier.dropout(0.2), weight=LinearRamp(0.0, 2.0, 0, 100))
    plain = CAPenalty(cloud.moments, Multiplier.dropout(0.2))(cloud.opacity, cloud.colors)
    for step, weight in ((0, 0.0), (25, 0.5), (100, 2.0)):
        penalty.set_step(step)
        assert penalty.weight == weight
        result = penalty(cloud.opacity, cloud.colors)
        assert torch.equal(result.image, plain.image)
        assert torch.equal(result.variance, plain.variance)
        assert result.penalty == weight * plain.penalty


def test_evaluation_is_like_training_and_nothing_is_drawn():
    cloud = Cloud(5)
    penalty = CAPenalty(cloud.moments, Multiplier.dropout(0.2))
    before = torch.get_rng_state()
    trained = penalty(cloud.opacity, cloud.colors)
    evaluated = penalty.eval()(cloud.opacity, cloud.colors)
    assert all(torch.equal(a, b) for a, b in zip(trained, evaluated, strict=True))
    assert torch.equal(torch.get_rng_state(), before)


def test_printing_shows_the_arguments():
    assert "variance=0.25), weight=1.0" in repr(CAPenalty(Cloud(2).moments, Multiplier.dropout(0.5)))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"moments_fn": None}, TypeError, "moments_fn must be callable"),
        ({"multiplier": 0.2}, TypeError, "Multiplier.dropout"),
        ({"weight": -1.0}, ValueError, "weight .*at least 0"),
        ({"weight": Constant(-1.0)}, ValueError, "weight .*at least 0"),
        ({"weight": "1"}, TypeError, "weight .*real number"),
        ({"layout": "WHC"}, ValueError, "layout .*one of"),
    ],
)
def test_wrong_arguments_are_refused_at_construction(change, error, message):
    good = {"moments_fn": Cloud(2).moments, "multiplier": Multiplier.dropout(0.2)} | change
    with pytest.raises(error, match=message):
        CAPenalty(good.pop("moments_fn"), good.pop("multiplier"), **good)


def test_wrong_calls_are_refused():
    cloud = Cloud(5)
    dropout = Multiplier.dropout(0.2)
    with pytest.raises(ValueError, match="sigmoid"):
        CAPenalty(cloud.moments, dropout)(torch.tensor([-1.0, 0.5, 0.5, 0.5, 0.5]).double(), cloud.colors)
    with pytest.raises(TypeError, match="return a Multiplier"):
        CAPenalty(cloud.moments, lambda o: o)(cloud.opacity, cloud.colors)
    with pytest.raises(TypeError, match="without variance"):
        CAPenalty(lambda *_: {"mean": cloud.target, "alpha_mean": cloud.target[0]}, dropout)(cloud.opacity, None)
    falling = CAPenalty(cloud.moments, dropout, weight=lambda step: 1 - step)
    with pytest.raises(ValueError, match="weight at step 2"):
        falling.set_step(2)
