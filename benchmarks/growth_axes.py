"""The workloads of the growth benchmark: along every axis one quantity grows and the others stay."""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.workloads import WORKLOADS, WorkloadSpec, covered_pairs

__all__ = ["Axis", "calibrated", "gaussians_per_pixel", "growth_axes"]

_SAMPLE = 10_000  # Gaussians that are counted; they are independent, so their number only scales the count
_TOLERANCE = 0.01
_ATTEMPTS = 60
_PER_PIXEL = 45.0  # as in the standard workloads
_GAUSSIANS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
_SIDES = (64, 128, 256, 512, 1024)
_LISTS = (15.0, 45.0, 150.0, 450.0, 1500.0)
_MEDIUM = WORKLOADS["medium"]


class Axis(NamedTuple):
    """One quantity that grows.

    Args:
        title: what grows and what stays.
        unit: of what grows.
        points: workloads by how much there is of it, in growing order.
    """

    title: str
    unit: str
    points: dict[float, WorkloadSpec]


def growth_axes(largest: int) -> dict[str, Axis]:
    """Choose the workloads.

    Args:
        largest: number of Gaussians that none exceeds.

    Returns:
        Axes by name: "gaussians" (of shrinking size, so that as many as before cover a pixel), "layers" (Gaussians of
        the same size, so that the lists grow with them), "pixels" and "lists" (the same Gaussians grow).

    Raises:
        ValueError: if ``largest`` is below the smallest workload.
    """
    numbers = [n for n in _GAUSSIANS if n <= largest]
    if not numbers:
        raise ValueError(f"largest must be at least {_GAUSSIANS[0]} Gaussians, got {largest}.")
    some = min(_MEDIUM.gaussians, largest)
    width, height = _MEDIUM.width, _MEDIUM.height
    return {
        "gaussians": Axis(
            f"Gaussians, 512x512, {_PER_PIXEL:g} of them at a pixel",
            "Gaussians",
            {n: calibrated(n, 512, 512, _PER_PIXEL) for n in numbers},
        ),
        "layers": Axis(
            f"Gaussians of constant size, {width}x{height}",
            "Gaussians",
            {n: WorkloadSpec(n, width, height, _MEDIUM.base_scale) for n in numbers},
        ),
        "pixels": Axis(
            f"pixels, {some} Gaussians, {_PER_PIXEL:g} of them at a pixel",
            "pixels",
            {side * side: calibrated(some, side, side, _PER_PIXEL) for side in _SIDES},
        ),
        "lists": Axis(
            f"Gaussians at a pixel, {some} of growing size, {width}x{height}",
            "Gaussians at a pixel",
            {x: calibrated(some, width, height, x) for x in _LISTS},
        ),
    }


def gaussians_per_pixel(spec: WorkloadSpec) -> float:
    """Return how many Gaussians reach an alpha of 1/255 at the mean pixel, estimated from 10,000 of them."""
    counted = min(spec.gaussians, _SAMPLE)
    pairs = covered_pairs(WorkloadSpec(counted, spec.width, spec.height, spec.base_scale).make())
    return pairs * spec.gaussians / counted / (spec.width * spec.height)


def calibrated(gaussians: int, width: int, height: int, per_pixel: float) -> WorkloadSpec:
    """Choose the scale at which so many Gaussians reach the mean pixel, to 1 percent.

    Args:
        gaussians: number of them.
        width: of the picture, pixels.
        height: of the picture, pixels.
        per_pixel: how many shall reach an alpha of 1/255 at the mean pixel.

    Raises:
        ValueError: if even points, which are drawn about a pixel wide, cover more, or all of them together less.

    Example:
        >>> spec = calibrated(2_000, 128, 128, 45.0)
        >>> round(spec.base_scale / WORKLOADS["small"].base_scale, 1)
        1.0
    """
    scale = (per_pixel / gaussians) ** 0.5 / 7  # near the answer while Gaussians are wider than a pixel
    for _ in range(_ATTEMPTS):
        spec = WorkloadSpec(gaussians, width, height, scale)
        ratio = per_pixel / gaussians_per_pixel(spec)
        if abs(ratio - 1) <= _TOLERANCE:
            return spec
        # The area grows with the square of the scale or more slowly, so this never steps over the answer.
        scale *= ratio**0.5
    raise ValueError(
        f"{gaussians} Gaussians on {width}x{height} pixels cannot be {per_pixel:g} at the mean pixel: "
        "choose a number between what points cover and all of them."
    )
