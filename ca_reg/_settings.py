"""Derive the settings of a score from its arguments: which method they select, and its defaults."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ca_reg._check import check_count, check_finite, check_rate
from ca_reg.result import CASettings, Method

__all__ = ["GROUPS", "LEAST", "ROUND", "make_settings"]

GROUPS = 8
"""Renders are pooled in at most this many groups, which bounds the memory; fewer groups would make the standard error
less certain (its relative error is about 1/sqrt(2 (groups - 1)), here 27 %)."""

ROUND = 8
"""Renders that adaptive sampling adds between checks of the error."""

LEAST = 16
"""Renders before the first check: the error is then known to 18 %. Stopping where the estimated error happens to be
small biases it downward, the more so the less certain it is: with 8 renders it is known to 27 %."""

_GIVEN = ("samples", "ddof", "relative_error", "max_samples")
_METHODS: dict[Method, tuple[tuple[str, ...], str]] = {  # which of these apply, and what to say of the others
    "sampling": (("samples", "ddof"), "give relative_error as well for adaptive sampling"),
    "adaptive": (
        ("relative_error", "max_samples"),
        "with relative_error the number of renders is found (up to max_samples), and ddof is 1",
    ),
    "exact": ((), "an exact score samples nothing"),
    "exact_neutral": ((), "an exact score samples nothing"),
}


def make_settings(
    *,
    exact: bool,
    neutral: bool,
    drop_rate: float | None,
    regularizer: str | None,
    threshold: float,
    seed: int,
    **given: Any,
) -> CASettings:
    """Find the method and fill in its defaults; raise if an argument is out of range or does not apply.

    ``given`` holds samples, ddof, relative_error and max_samples, each None unless the caller set it.
    """
    if drop_rate is not None:
        check_rate(drop_rate, "drop_rate")
    check_finite(threshold, "threshold")
    check_count(seed, "seed", minimum=0)
    samples, ddof, relative_error, max_samples = (given[name] for name in _GIVEN)
    method = _method(exact, neutral, relative_error)
    applies, remedy = _METHODS[method]
    for name, value in given.items():
        if value is not None and name not in applies:
            raise ValueError(f"{name} does not apply to the method {method!r}: {remedy}.")
    drop_rate = None if drop_rate is None else float(drop_rate)
    settings = CASettings(method=method, drop_rate=drop_rate, regularizer=regularizer, threshold=float(threshold))
    if method == "sampling":
        samples, ddof = 5 if samples is None else samples, 0 if ddof is None else ddof
        check_count(samples, "samples", minimum=2)
        check_count(ddof, "ddof", minimum=0)
        if ddof >= samples:
            raise ValueError(f"ddof must be below samples, got ddof {ddof} and {samples} samples.")
        return replace(settings, samples=int(samples), ddof=int(ddof), seed=int(seed))
    if relative_error is not None:
        max_samples = 256 if max_samples is None else max_samples
        check_finite(relative_error, "relative_error")
        if relative_error <= 0:
            raise ValueError(f"relative_error must be above 0, got {relative_error}; for an exact score, give exact.")
        check_count(max_samples, "max_samples", minimum=LEAST)
        return replace(
            settings, ddof=1, seed=int(seed), relative_error=float(relative_error), max_samples=int(max_samples)
        )
    return settings


def _method(exact: bool, neutral: bool, relative_error: float | None) -> Method:
    """Return the method that the arguments select."""
    if exact:
        return "exact_neutral" if neutral else "exact"
    if neutral:
        raise ValueError("neutral needs exact: compositing over the expected color takes a renderer with moments.")
    return "sampling" if relative_error is None else "adaptive"
