"""The recursion of exact moments over a few list entries of many tiles: a compiler fuses each function into one loop.

The entries of a tile are unrolled, nearest first, so that all between the coefficients of an entry and the state of a
pixel stays in registers. Executed operation by operation the functions are slow: `reference_trainer.render.compiled`
runs them. The recursion is that of `reference_trainer.render.recursion`.

``pixels`` (6, 64) holds the monomials of a tile's pixels. Of n tiles with R entries each: ``polynomial`` (n, R, 6) of
the log-alphas, ``values`` (n, R, C) to be composited, ``factors`` (n, R, 2) mean and variance of the random factor.
States and results are (n, 64) each, or lists of them, one per channel or entry, and are written in place: separate
tensors, as what is stacked afterwards costs a pass of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA

__all__ = [
    "behind_rows",
    "gradient_rows",
    "moment_rows",
]


def moment_rows(
    pixels: Tensor,
    polynomial: Tensor,
    values: Tensor,
    factors: Tensor,
    mean: list[Tensor],
    variance: list[Tensor],
) -> None:
    """Composite back to front with random factors.

    Args:
        pixels: the monomials.
        polynomial: of the entries.
        values: of the entries.
        factors: of the entries.
        mean: of the colours behind the entries, of every channel; becomes that in front of them.
        variance: likewise.
    """
    means, variances = list(mean), list(variance)
    for i in reversed(range(polynomial.shape[1])):
        terms = _terms(polynomial, factors, i, pixels)
        for c in range(len(means)):
            contrast = values[:, i, c, None] - means[c]
            variances[c] = variances[c] * terms.shrink + terms.spread * (contrast * contrast)
            means[c] = means[c] + terms.expected * contrast
    _store(mean, means)
    _store(variance, variances)


def behind_rows(
    pixels: Tensor,
    polynomial: Tensor,
    values: Tensor,
    factors: Tensor,
    to_variance: list[Tensor],
    mean: list[Tensor],
    hidden: Tensor,
) -> None:
    """Walk back to front and find what the gradients of the entries in front must know.

    Args:
        pixels: the monomials.
        polynomial: of the entries.
        values: of the entries.
        factors: of the entries.
        to_variance: gradient of the variances, of every channel.
        mean: as in `moment_rows`.
        hidden: see `reference_trainer.render.moment_gradients`, of the last entry, (n, 64); becomes that of the entry
            in front of the first.
    """
    means, below = list(mean), hidden
    for i in reversed(range(polynomial.shape[1])):
        terms = _terms(polynomial, factors, i, pixels)
        _, to_weight, means = _step(values, i, means, to_variance, terms)
        below = below * terms.shrink + to_weight * terms.spread
    _store(mean, means)
    hidden.copy_(below)


def gradient_rows(
    pixels: Tensor,
    polynomial: Tensor,
    values: Tensor,
    factors: Tensor,
    to_variance: list[Tensor],
    mean: list[Tensor],
    hidden: Tensor,
    front: Tensor,
    to_mean: list[Tensor],
    to_exponent: list[Tensor],
    to_values: list[Tensor],
    to_factors: list[Tensor],
) -> None:
    """Find the gradients of mean and variance.

    Args:
        pixels: the monomials.
        polynomial: of the entries.
        values: of the entries.
        factors: of the entries.
        to_variance: gradient of the variances, of every channel.
        mean: behind the entries, of every channel; unchanged, as is
        hidden: of the last entry, (n, 64).
        front: the product of ``shrink`` in front of the entries, (n, 64); becomes that behind them.
        to_mean: gradient of the mean in front of the entries, of every channel; becomes that of the mean behind them.
        to_exponent: receives the gradient of every entry's ln alpha at every pixel.
        to_values: receives that of the values, of every entry all channels.
        to_factors: receives that of the factors' moments, of every entry both.
    """
    means, below = list(mean), hidden
    walked = []
    for i in reversed(range(polynomial.shape[1])):
        terms = _terms(polynomial, factors, i, pixels)
        contrasts, to_weight, means = _step(values, i, means, to_variance, terms)
        walked.append((terms, contrasts, to_weight, below))
        below = below * terms.shrink + to_weight * terms.spread
    product, upstream = front, list(to_mean)
    exponents, colors, moments = [], [], []
    for terms, contrasts, to_weight, below in reversed(walked):
        alpha, m, v, expected, spread, shrink = terms[1:]
        twice = 2 * product * spread
        through = [upstream[c] * expected + to_variance[c] * contrasts[c] * twice for c in range(len(upstream))]
        to_shrink = below * product
        to_spread = to_weight * product + to_shrink
        to_expected = sum(g * d for g, d in zip(upstream, contrasts, strict=True)) - 2 * (1 - expected) * to_shrink
        exponents.append(terms.raw * (2 * v * (to_spread * alpha) + to_expected * m))
        colors.extend(through)
        moments.extend([to_expected * alpha, to_spread * (alpha * alpha)])
        upstream = [g - t for g, t in zip(upstream, through, strict=True)]
        product = product * shrink
    front.copy_(product)
    _store(to_mean, upstream)
    _store(to_exponent, exponents)
    _store(to_values, colors)
    _store(to_factors, moments)


class _Terms(NamedTuple):
    """What the recursion of the moments needs of one entry, (n, 64) each; m and v (n, 1)."""

    raw: Tensor
    alpha: Tensor
    m: Tensor
    v: Tensor
    expected: Tensor
    spread: Tensor
    shrink: Tensor


def _raw_alpha(polynomial: Tensor, i: int, pixels: Tensor) -> Tensor:
    """Return the alphas of an entry before the clamp, 0 below `MIN_ALPHA`."""
    exponent = polynomial[:, i, 0, None]
    for k in range(1, 6):
        exponent = exponent + polynomial[:, i, k, None] * pixels[k]
    raw = torch.exp2(exponent)
    return torch.where(raw > MIN_ALPHA, raw, 0.0)


def _terms(polynomial: Tensor, factors: Tensor, i: int, pixels: Tensor) -> _Terms:
    """Evaluate one entry for the recursion of the moments."""
    raw = _raw_alpha(polynomial, i, pixels)
    alpha = raw.clamp(max=MAX_ALPHA)
    m, v = factors[:, i, 0, None], factors[:, i, 1, None]
    expected, spread = alpha * m, alpha * alpha * v
    return _Terms(raw, alpha, m, v, expected, spread, (1 - expected) * (1 - expected) + spread)


def _step(
    values: Tensor, i: int, means: list[Tensor], to_variance: list[Tensor], terms: _Terms
) -> tuple[list[Tensor], Tensor, list[Tensor]]:
    """Return an entry's contrasts, the gradient of its weight in the variance, and the means in front of it."""
    contrasts = [values[:, i, c, None] - mean for c, mean in enumerate(means)]
    to_weight = torch.zeros_like(terms.alpha)
    for c, contrast in enumerate(contrasts):
        to_weight = to_weight + to_variance[c] * (contrast * contrast)
    return contrasts, to_weight, [mean + terms.expected * d for mean, d in zip(means, contrasts, strict=True)]


def _store(targets: list[Tensor], results: list[Tensor]) -> None:
    """Write results in place."""
    for target, result in zip(targets, results, strict=True):
        target.copy_(result)
