"""All pairs of scoring options: each is held against the protocol written out in numpy, or refused by name.

The protocol here shares nothing with the package: plain compositing, masks from the documented seeds, all 2^n masks
for what is exact.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from oracles import split_mix

from ca_reg import CAScore, Reason

N, HEIGHT, WIDTH = 11, 3, 5
RNG = np.random.default_rng(2)
FOOTPRINT = RNG.random((N, HEIGHT, WIDTH)) ** 0.5 * np.linspace(0.2, 1.0, WIDTH)
COLORS, OPACITY = RNG.random((N, 3)), 0.8 + 0.2 * RNG.random(N)
WHITE, BLACK, BACKGROUND = np.ones((N, 3)), np.zeros((3, 1, 1)), np.array([0.9, 0.1, 0.4]).reshape(3, 1, 1)


def blend(opacity, colors, background):
    """Back to front: opacities (..., N) over a background (3, 1, 1) or (3, H, W) to images (..., 3, H, W)."""
    image = background
    for i in reversed(range(N)):
        alpha = (opacity[..., i, None, None] * FOOTPRINT[i])[..., None, :, :]
        image = alpha * colors[i][:, None, None] + (1 - alpha) * image
    return image


def image_and_alpha(opacity, background):
    return blend(opacity, COLORS, background), blend(opacity, WHITE, BLACK)[..., 0, :, :]


MASKS = np.array(list(itertools.product([0.0, 1.0], repeat=N)))
IMAGES, ALPHAS = image_and_alpha(OPACITY * MASKS, BLACK)  # of all masks, over black


def all_masks(rate, neutral=False, behind=None):
    """Mean and variance of the colors and mean alpha over all masks, weighted by their probability."""
    weights = np.prod(np.where(MASKS > 0, 1 - rate, rate), axis=1)
    alpha = np.einsum("k,khw->hw", weights, ALPHAS)
    if behind is None:
        behind = np.einsum("k,kchw->chw", weights, IMAGES) / alpha if neutral else BACKGROUND
    images = IMAGES + (1 - ALPHAS)[:, None] * behind
    mean = np.einsum("k,kchw->chw", weights, images)
    return mean, np.einsum("k,kchw->chw", weights, (images - mean) ** 2), alpha


def masked_renders(rate, seed, index, count):
    words = split_mix(int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0]), count * N)
    keep = np.array([(word >> 40) / 2**24 >= rate for word in words]).reshape(count, N)
    return image_and_alpha(OPACITY * keep, BACKGROUND)


def truth(options, samples):
    """Value, variance map and region of the protocol with these options; ``samples`` were made if it was adaptive."""
    get = options.get
    rate, threshold = get("drop_rate", 1 - (1 - get("p", 0.0)) / 2), get("threshold", 0.8)
    if get("exact"):
        _, variance, alpha = all_masks(rate, get("neutral", False))
        visible, variance = alpha > threshold, variance.mean(0)
    else:
        adaptive = "relative_error" in options
        count = samples if adaptive else get("samples", 5)
        images, alphas = masked_renders(rate, get("seed", 0), get("index", 0), count)
        variance = images.var(axis=0, ddof=1 if adaptive else get("ddof", 0)).mean(0)
        visible = all_masks(rate)[2] > threshold if adaptive else (alphas > threshold).all(0)
    return variance[visible].mean(), variance, visible


# --- the same renderer as callables of a score ---


def ordered(image, layout):
    return torch.from_numpy(np.ascontiguousarray(image if layout == "CHW" else image.transpose(1, 2, 0)))


def score_of(options):
    """The score, and its result."""
    options = dict(options)
    index, layout = options.pop("index", 0), options.get("layout", "CHW")

    def render_fn(opacity, view):
        image, alpha = image_and_alpha(opacity.numpy(), BACKGROUND)
        return ordered(image, layout) if "alpha_fn" in options else (ordered(image, layout), torch.from_numpy(alpha))

    def alpha_fn(opacity, view):
        return ordered(blend(opacity.numpy(), WHITE, BLACK), layout)

    def moments(opacity, view, multiplier, background):
        if background is not None:
            background = background.permute(2, 0, 1) if background.ndim == 3 and layout == "HWC" else background
            background = background.numpy().reshape(3, *(background.shape[1:] or (1, 1)))
        mean, variance, alpha = all_masks(1 - multiplier.mean, behind=background)
        images = {"mean": ordered(mean, layout), "variance": ordered(variance, layout)}
        return images | {"alpha_mean": torch.from_numpy(alpha)}

    options |= {"alpha_fn": alpha_fn} if "alpha_fn" in options else {}
    if options.pop("exact", False):
        score = CAScore.exact(moments, **options)
    else:
        score = (CAScore.adaptive if "relative_error" in options else CAScore)(render_fn, **options)
    return score(torch.from_numpy(OPACITY), None, index=index)


# --- the table ---

VALUES = {
    "samples": 3, "p": 0.2, "drop_rate": 0.3, "threshold": 0.85, "ddof": 1, "layout": "HWC", "alpha_fn": True,
    "seed": 8, "index": 4, "exact": True, "neutral": True, "relative_error": 0.15, "max_samples": 24,
}  # fmt: skip

# = the protocol in numpy says the same    x refused by name    on the diagonal: the option alone
#                 samples                         exact
#                 |  p                            |  neutral
#                 |  |  drop_rate                 |  |  relative_error
#                 |  |  |  threshold              |  |  |  max_samples
#                 |  |  |  |  ddof                |  |  |  |
#                 |  |  |  |  |  layout           |  |  |  |
#                 |  |  |  |  |  |  alpha_fn      |  |  |  |
#                 |  |  |  |  |  |  |  seed       |  |  |  |
#                 |  |  |  |  |  |  |  |  index   |  |  |  |
TABLE = """
samples           =  .  .  .  .  .  .  .  .  .    .  .  .
p                 =  =  .  .  .  .  .  .  .  .    .  .  .
drop_rate         =  =  =  .  .  .  .  .  .  .    .  .  .
threshold         =  =  =  =  .  .  .  .  .  .    .  .  .
ddof              =  =  =  =  =  .  .  .  .  .    .  .  .
layout            =  =  =  =  =  =  .  .  .  .    .  .  .
alpha_fn          =  =  =  =  =  =  =  .  .  .    .  .  .
seed              =  =  =  =  =  =  =  =  .  .    .  .  .
index             =  =  =  =  =  =  =  =  =  .    .  .  .
exact             x  =  =  =  x  =  x  x  =  =    .  .  .
neutral           x  x  x  x  x  x  x  x  x  =    x  .  .
relative_error    x  =  =  =  x  =  =  =  =  x    x  =  .
max_samples       x  x  x  x  x  x  x  x  x  x    x  =  x
"""
ROWS = {name: marks for name, *marks in (line.split() for line in TABLE.strip().splitlines())}
PAIRS = [(one, other, mark) for one, marks in ROWS.items() for other, mark in zip(ROWS, marks, strict=True)
         if mark != "."]  # fmt: skip


def test_the_table_names_every_option_and_every_pair():
    import inspect

    ways = (CAScore, CAScore.exact, CAScore.adaptive)
    options = {"exact", "index"}.union(*(inspect.signature(way).parameters for way in ways))
    options -= {"render_fn", "moments_fn", "regularizer"}  # the last: test_score_regularizer.py
    assert list(VALUES) == list(ROWS)
    assert set(VALUES) == options
    assert len(PAIRS) == len(VALUES) * (len(VALUES) + 1) // 2


@pytest.mark.parametrize(("one", "other", "mark"), PAIRS, ids=[f"{a}-{b}" for a, b, _ in PAIRS])
def test_a_pair_of_options_does_what_it_says_or_is_refused(one, other, mark):
    options = {name: VALUES[name] for name in (one, other)}
    if mark == "x":
        with pytest.raises(TypeError, match=f"unexpected keyword argument '({one}|{other})'"):
            score_of(options)
        return
    result = score_of(options)
    value, variance, visible = truth(options, result.samples)
    assert result.reason is Reason.OK
    assert 0 < visible.sum() < visible.size
    np.testing.assert_array_equal(result.visible.numpy(), visible)
    np.testing.assert_allclose(result.variance.numpy(), variance, rtol=1e-9, atol=1e-15)
    assert result.value == pytest.approx(value, rel=1e-9)
    if "exact" in options:
        assert (result.std_error, result.samples) == (0.0, None)
    elif "relative_error" in options:
        assert result.samples in range(16, options.get("max_samples", 256) + 1, 8)
        assert result.std_error <= 0.15 * result.value or result.samples == options.get("max_samples", 256)
    else:
        assert result.std_error > 0
        assert not math.isnan(result.std_error)
