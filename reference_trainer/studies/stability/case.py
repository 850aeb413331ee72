"""Cases of the stability study: what to push to an extreme, what to compare with, and how it may end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from reference_trainer.studies.stability.quantities import RATE, Quantities, reference_quantities, scene_quantities
from reference_trainer.studies.stability.scenes import StressScene

__all__ = ["Case", "Probe", "decades", "of_scene", "single"]


class Probe(NamedTuple):
    """A comparison: a computation as users run it, and its reference result."""

    measured: Callable[[], Quantities]
    reference: Callable[[], Quantities]


@dataclass(frozen=True)
class Case:
    """One way of pushing the package to an extreme.

    Args:
        family: heading of the table.
        name: what is extreme.
        probe: returns the comparison at a magnitude.
        magnitudes: from harmless to extreme, increasing, positive; a single one for a case without a scale.
        until: the largest magnitude at which all quantities must be right.
        beyond: what is allowed above it: an error that names the mistake; a documented limit, finite but less exact; or
            an infinity where the dtype has no larger number.
        note: the documented limit, or what refuses.
        draws: whether it uses an engine of the renderer; if not, it is judged once for all engines.
    """

    family: str
    name: str
    probe: Callable[[float], Probe]
    magnitudes: tuple[float, ...] = (1.0,)
    until: float = math.inf
    beyond: Literal["refused", "limit", "overflow"] = "limit"
    note: str = ""
    draws: bool = True


def single(family: str, name: str, probe: Callable[[], Probe], *, refused: str = "", draws: bool = True) -> Case:
    """Return a case without a scale, which must be right, or may be refused if ``refused`` names by what."""
    until = 0.0 if refused else math.inf
    return Case(family, name, lambda _: probe(), until=until, beyond="refused", note=refused, draws=draws)


def decades(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from 10^first to 10^last.

    Example:
        >>> decades(-1, 1)
        (0.1, 1.0, 10.0)
    """
    return tuple(float(f"1e{k}") for k in range(first, last + 1, step))


def of_scene(
    scene: StressScene, *, dtype: torch.dtype = torch.float32, independent: bool = True, rate: float = RATE
) -> Probe:
    """Compare everything computed from a scene with float64, at inputs that both precisions represent exactly.

    Args:
        scene: what to render; it is first rounded to ``dtype``, except for the pose.
        dtype: of the computation.
        independent: compare image, alpha and gradients with the independent renderer, not with the same one in float64.
        rate: of dropout, in the draw, the moments and the score.
    """
    scene = scene.rounded(dtype)
    return Probe(
        lambda: scene_quantities(scene, dtype, rate=rate),
        lambda: (
            reference_quantities(scene, rate=rate) if independent else scene_quantities(scene, torch.float64, rate=rate)
        ),
    )
