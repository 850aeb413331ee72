"""Rank correlation with ties: how far two scores put the same models in the same order."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

__all__ = ["kendall", "spearman"]


def spearman(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return Spearman's rho: the Pearson correlation of the ranks, tied values sharing the mean of their ranks.

    Args:
        x: finite values, at least one.
        y: as many.

    Returns:
        A number in [-1, 1]; None where none exists, because all values of ``x`` or of ``y`` are equal.

    Raises:
        ValueError: if the lengths differ, there is no value, or one is not finite.

    Example:
        >>> spearman([1.0, 2.0, 3.0, 4.0], [10.0, 10.1, 90.0, 80.0])
        0.8
    """
    a, b = (_ranks(values) for values in _checked(x, y))
    a, b = a - a.mean(), b - b.mean()  # exact: ranks and their mean are multiples of 1/2
    return _ratio(float(a @ b), float(a @ a), float(b @ b))


def kendall(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return Kendall's tau-b: pairs in the same order less pairs in opposite order, over the pairs without a tie.

    The number of untied pairs is the geometric mean of that in ``x`` and that in ``y``. Takes time and memory of
    len(x)^2.

    Args:
        x: finite values, at least one.
        y: as many.

    Returns:
        A number in [-1, 1]; None where none exists, because all values of ``x`` or of ``y`` are equal.

    Raises:
        ValueError: if the lengths differ, there is no value, or one is not finite.

    Example:
        >>> round(kendall([1.0, 2.0, 3.0, 4.0], [10.0, 10.1, 90.0, 80.0]), 3)  # 5 pairs agree, 1 does not
        0.667
    """
    a, b = (np.sign(values[:, None] - values[None, :]) for values in _checked(x, y))
    return _ratio(float((a * b).sum()), float((a * a).sum()), float((b * b).sum()))


def _checked(x: Sequence[float], y: Sequence[float]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return both as float64, or say what is wrong with them."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape or a.size == 0:
        raise ValueError(f"expected two sequences of one length, at least 1, got shapes {a.shape} and {b.shape}.")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("values must be finite: leave out the pairs in which one is missing.")
    return a, b


def _ranks(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return ranks from 1 on, tied values sharing the mean of theirs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: npt.NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[which]
    return ranks


def _ratio(product: float, square_x: float, square_y: float) -> float | None:
    """Normalise a product by the two squares."""
    return None if square_x == 0 or square_y == 0 else product / math.sqrt(square_x * square_y)
