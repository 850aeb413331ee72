"""All pairs of the options that change what is drawn, expected, lost or rendered at test time, on two Gaussians.

Each pair is either refused by name, or held against a restatement of what its two options say that shares no formula
with the package: a draw is written down from the random numbers of the step, and an expectation is the weighted sum
over all draws, rendered one by one in float64 (every mask; of the noise, a quadrature with its atoms at 0 and 1).
"""

import dataclasses
import functools
import math
from contextlib import nullcontext
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from ca_reg import Chain, GaussianDropout, OpacityNoise
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians, render_moments_of
from reference_trainer.render import render
from reference_trainer.renderers import gsplat as kernels
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import expected_photometric_loss, photometric_loss
from reference_trainer.training.randomness import deterministic, stream
from reference_trainer.training.recipes import RECIPES
from reference_trainer.training.trainer import Trainer

P, SIGMA, WEIGHT = 0.4, 0.8, 3.0
OPTIONS: dict[str, dict[str, object]] = {
    "dropout": {"dropout": P},
    "compensate": {},  # an argument of the dropout's expression
    "noise": {"noise": SIGMA},
    "clip": {},  # an argument of the noise's
    "scale": {},  # likewise
    "analytic": {"analytic": True},
    "regularize_from": {"regularize_from": 1},
    "sh_degree": {"sh_degree": 1},
    "loss": {"loss": f"photometric(0.0) + co_adaptation({WEIGHT}, {P})"},
    "renderer": {"renderer": "gsplat"},
    "white": {},  # the scene's background
    "deterministic": {},  # of the command
    "recipe inria": {"recipe": "inria"},
    "recipe binocular": {"recipe": "binocular"},
}
NEEDS = {"compensate": "dropout", "clip": "noise", "scale": "noise"}
REFUSED = {
    ("analytic", "recipe binocular"): "analytic training has no draw, which Alpha, Warp needs",
    ("analytic", "renderer"): "analytic training needs the moments of the builtin renderer",
    ("loss", "renderer"): "the loss needs moments, which the renderer gsplat lacks",
}
SCHEDULE = {  # what decides when and how fast, and enters no single step
    "iterations", "seed", "sh_every", "means_rate", "means_rate_final", "scales_rate", "quaternions_rate",
    "opacity_rate", "color_rate", "initial_points", "initial_scale", "initial_opacity", "densify_from", "densify_until",
    "densify_every", "densify_gradient", "dense_fraction", "prune_opacity", "prune_size", "prune_size_from",
    "max_gaussians", "opacity_reset", "opacity_reset_from", "opacity_reset_every", "opacity_reset_over_white",
    "opacity_decay", "density", "guard",
}  # fmt: skip


def test_every_setting_is_an_option_here_or_a_matter_of_the_schedule():
    named = {field for settings in OPTIONS.values() for field in settings} - {"recipe"}
    elsewhere = {"regularizer", "models", "random_background"}  # test_every_regularizer.py, test_models.py
    assert named | SCHEDULE | elsewhere == {field.name for field in dataclasses.fields(TrainConfig)}
    assert not named & SCHEDULE


class Draws(NamedTuple):
    """What the options say about the draws, in the words of this file."""

    p: float = 0.0
    compensate: bool = False
    sigma: float = 0.0
    clip: bool = False


def together(pair: tuple[str, ...]) -> tuple[TrainConfig, Draws, bool]:
    """The settings of two options and of what these are nothing without, their draws, and if the noise is scaled."""
    names = {*pair, *(NEEDS[name] for name in pair if name in NEEDS)}
    if "analytic" in names and not names & {"dropout", "noise"}:
        names.add("dropout")
    settings = {key: value for name in OPTIONS if name in names for key, value in OPTIONS[name].items()}
    draws = Draws(P * ("dropout" in names), "compensate" in names, SIGMA * ("noise" in names), "clip" in names)
    terms = []
    if draws.compensate:
        terms.append(f"dropout({settings.pop('dropout')}, compensate=True)")
    if draws.sigma and (draws.compensate or names & {"clip", "scale"}):  # in the order of the draws
        terms.append(f"noise({settings.pop('noise')}, clip={draws.clip}, scale={'scale' in names})")
    recipe = RECIPES[settings.pop("recipe", "3dgs")].config
    short = {"iterations": 2, "sh_degree": 0, "sh_every": 1, "regularizer": " + ".join(terms)}
    return dataclasses.replace(recipe, **{**short, **settings}), draws, "scale" in names


# Two Gaussians in front of a camera of 6 x 6 pixels. At every pixel both falloffs are between 0.4 and 0.99, so that the
# noise cannot reach the clamp of alpha; the quadrature has no node between 0 and the cut at 1/255. Survivors without
# noise do reach the clamp.
OPACITIES = (0.9, 0.5)
CAMERA = Camera(torch.eye(4), 6.0, 6.0, 3.0, 3.0, 6, 6)


def scene(white: bool) -> Scene:
    g = torch.Generator().manual_seed(0)
    view = View("a", CAMERA, torch.rand(3, 6, 6, generator=g))
    points = PointCloud(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]), torch.rand(2, 3, generator=g), "hand")
    return Scene("two", (view,), (), points, torch.full((3,), float(white)))


def two(of: Scene, degree: int, dtype: torch.dtype) -> Gaussians:
    positions, colors = of.points.positions, of.points.colors
    start = Gaussians.from_points(positions, colors, 3.6 * positions[:, 2] / 6, sh_degree=degree)
    rest = 0.3 * torch.randn(start.sh_rest.shape, generator=torch.Generator().manual_seed(1))
    logits = torch.logit(torch.tensor(OPACITIES, dtype=torch.float64))
    return dataclasses.replace(start, opacity_logits=logits, sh_rest=rest).map(lambda x: x.detach().to(dtype))


def regularized(draws: Draws, keep: Tensor, noise: Tensor, opacities: Tensor) -> Tensor:
    """What one draw hands the rasterizer; noise in standard deviations."""
    survivors = opacities / (1 - draws.p) if draws.compensate else opacities
    drawn = torch.where(keep, survivors, 0.0)
    if draws.sigma > 0:
        drawn = (drawn * (1 + draws.sigma * (noise.clamp(-1, 1) if draws.clip else noise))).clamp(0, 1)
    return drawn


def draws_of_one(draws: Draws, opacity: float) -> tuple[Tensor, Tensor]:
    """All draws of one Gaussian: opacities to render and their probabilities, shape (K,)."""
    z, weight = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    if draws.sigma > 0:
        survivor = opacity / (1 - draws.p) if draws.compensate else opacity
        kinks = [-1 / draws.sigma, (1 / survivor - 1) / draws.sigma, *([-1, 1] if draws.clip else [])]
        ends = np.unique([-9.0, *kinks, 9.0])
        nodes, weights = np.polynomial.legendre.leggauss(7)
        x = ends[:-1, None] + np.diff(ends)[:, None] / 2 * (1 + nodes)
        z = torch.from_numpy(x).flatten()
        density = np.exp(-x * x / 2) / math.sqrt(2 * math.pi)
        mass = np.array([0.5 * (math.erf(b / 2**0.5) - math.erf(a / 2**0.5)) for a, b in pairwise(ends)])
        panel = density * weights
        weight = torch.from_numpy(panel / panel.sum(1, keepdims=True) * mass[:, None]).flatten()
    kept = regularized(draws, torch.tensor(True), z, torch.tensor(opacity, dtype=torch.float64))
    values, which = torch.unique(kept, return_inverse=True)
    weight = torch.zeros_like(values).index_add_(0, which, weight) * (1 - draws.p)
    none = torch.tensor([[0.0, draws.p]], dtype=torch.float64)
    return torch.cat([none[:, 0], values]), torch.cat([none[:, 1], weight])


@functools.cache
def enumerated(draws: Draws, degree: int, white: bool) -> tuple[Tensor, Tensor]:
    """Mean and variance of the render over all draws, float64."""
    world = scene(white)
    gaussians = two(world, degree, torch.float64)
    each = [list(zip(*draws_of_one(draws, o), strict=True)) for o in OPACITIES]
    images, probabilities = [], []
    for draw in product(*each):
        opacities, probability = torch.stack([value for value, _ in draw]), math.prod(p.item() for _, p in draw)
        images.append(render_gaussians(gaussians, CAMERA, world.background.double(), opacities=opacities).image)
        probabilities.append(probability)
    stack, weights = torch.stack(images), torch.tensor(probabilities, dtype=torch.float64)
    assert weights.sum().item() == pytest.approx(1, abs=1e-12)
    mean = torch.einsum("k,kchw->chw", weights, stack)
    return mean, torch.einsum("k,kchw->chw", weights, (stack - mean).square())


def put(trainer: Trainer, model: Gaussians) -> None:
    """Make a trainer go on with these Gaussians, as if no step had moved them."""
    tensors = dict(model.named())
    trainer.optimizer.load_state_dict({"gaussians": tensors, "moments": {name: {} for name in tensors}})


@pytest.fixture
def gsplat(monkeypatch):
    """The renderer of this package in the place of gsplat, which needs a card."""
    monkeypatch.setattr(kernels, "load_gsplat_render", lambda device: render)


@pytest.mark.parametrize("pair", list(combinations(OPTIONS, 2)), ids="-".join)
def test_a_pair_is_what_its_options_say_or_refused(pair, gsplat):
    if pair in REFUSED:
        with pytest.raises(ValueError, match=REFUSED[pair]):
            check(together(pair)[0])
        return
    (config, draws, scaled), white = together(pair), "white" in pair
    world = scene(white)
    lambda_dssim, weight = (0.0, WEIGHT) if "loss" in pair else (0.2, 0.0)
    trainer, target = Trainer(world, config), world.train[0].image
    for step in range(2):
        begun = step >= config.regularize_from
        at, analytic = (draws if begun else Draws()), config.analytic and begun
        put(trainer, two(world, config.sh_degree, torch.float32))
        with deterministic() if "deterministic" in pair else nullcontext():
            loss = trainer.train_step()
        if analytic:
            mean, variance = enumerated(at, config.sh_degree, white)
            expected = expected_photometric_loss(mean, variance, target.double(), lambda_dssim)
        else:
            generator = stream(config.seed, step, "regularizer")  # one after the other, and none for what is off
            keep = torch.rand(2, generator=generator) >= at.p if at.p else torch.tensor([True, True])
            noise = torch.randn(2, generator=generator)
            drawn = regularized(at, keep, noise, torch.tensor(OPACITIES))
            model = two(world, config.sh_degree, torch.float32)
            image = render_gaussians(model, CAMERA, world.background, opacities=drawn).image
            expected = photometric_loss(image, target, lambda_dssim)
            variance = enumerated(Draws(P), config.sh_degree, white)[1]  # of the term's own dropout
        assert loss == pytest.approx(expected.item() + weight * variance.mean().item(), abs=2e-5)
        # At test time the mean of the draws, but for noise: the paper scales for it only if it is asked to.
        put(trainer, two(world, config.sh_degree, torch.float32))
        counted = at if scaled else at._replace(sigma=0.0)
        means = torch.stack([torch.dot(*draws_of_one(counted, o)) for o in OPACITIES])
        torch.testing.assert_close(model_of(trainer).test_opacities.double(), means, rtol=0, atol=1e-6)


@pytest.mark.parametrize("white", [False, True], ids=["black", "white"])
@pytest.mark.parametrize(("sigma", "clip"), [(0.0, False), (SIGMA, False), (SIGMA, True)], ids=["-", "noise", "clip"])
@pytest.mark.parametrize(("p", "compensate"), [(0.0, False), (P, False), (P, True)], ids=["-", "drop", "inverted"])
def test_the_expected_render_is_the_sum_over_all_draws(p, compensate, sigma, clip, white):
    world, draws = scene(white), Draws(p, compensate, sigma, clip)
    mean, variance = enumerated(draws, 0, white)
    chain = Chain(GaussianDropout(p, compensate=compensate), OpacityNoise(sigma, clip=clip))
    x, multiplier = chain.alpha_factor(two(world, 0, torch.float64).params(CAMERA))
    out = render_moments_of(x, multiplier, CAMERA, world.background.double(), sh_degree=0)[0]
    close = {"rtol": 0, "atol": 1e-8 if sigma else 1e-13}
    torch.testing.assert_close(out.mean, mean, **close)
    torch.testing.assert_close(out.variance, variance, **close)
    assert variance.mean() > 0.01 or draws == Draws()
