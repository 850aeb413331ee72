"""What a case of the stability study is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from reference_trainer.studies.stability.quantities import Quantities, reference_quantities, scene_quantities
from reference_trainer.studies.stability.scenes import StressScene

__all__ = ["Case", "Probe", "decades", "of_scene", "single"]


class Probe(NamedTuple):
    """What to compare: a computation as users run it, and what it should give."""

    measured: Callable[[], Quantities]
    reference: Callable[[], Quantities]


@dataclass(frozen=True)
class Case:
    """One way of pushing the package to an extreme.

    Args:
        family: heading of the table.
        name: what is extreme.
        probe: the comparison at a magnitude.
        magnitudes: from harmless to extreme, increasing, positive; one for a case that has no scale.
        until: the largest magnitude at which all quantities must be right.
        beyond: what is allowed after it: an error that names the mistake; a documented limit, finite but less exact; or
            an infinity where the dtype has no larger number.
        note: the documented limit, or what refuses.
        draws: whether float32 is drawn, by an engine of the renderer; what is not is judged once for all engines.
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
    """Return a case without a scale, which must be right, or refused if it is said by what."""
    until = 0.0 if refused else math.inf
    return Case(family, name, lambda _: probe(), until=until, beyond="refused", note=refused, draws=draws)


def decades(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from 10^first to 10^last.

    Example:
        >>> decades(-1, 1)
        (0.1, 1.0, 10.0)
    """
    return tuple(float(f"1e{k}") for k in range(first, last + 1, step))


def of_scene(scene: StressScene, *, dtype: torch.dtype = torch.float32, independent: bool = True) -> Probe:
    """Compare everything that is computed of a scene with float64, at inputs that both can hold.

    Args:
        scene: what to render; it is rounded to ``dtype`` for both.
        dtype: of the computation.
        independent: compare image, alpha and gradients with the renderer of another kind, not with the same in float64.
    """
    scene = scene.to(dtype, camera=torch.float64).to(torch.float64)
    return Probe(
        lambda: scene_quantities(scene, dtype),
        lambda: reference_quantities(scene) if independent else scene_quantities(scene, torch.float64),
    )
