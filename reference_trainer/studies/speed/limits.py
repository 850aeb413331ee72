"""What the machine can do at best, and the time that no renderer can go below."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from reference_trainer.render.eager.projection import project
from reference_trainer.studies.speed.workloads import Workload
from reference_trainer.studies.timing import in_turns

__all__ = ["Limits", "bounds", "covered_pairs", "measure_limits"]

_CACHED_CPU, _CACHED_CUDA = 1 << 16, 1 << 24  # elements: 256 KiB stay in a core's cache; a GPU needs more to be busy
_LARGE = 1 << 26  # elements: 256 MiB, beyond any cache
_CALLS = 100  # of a function on the cached buffer per timing
_MIN_ALPHA = 1 / 255


@dataclass(frozen=True)
class Limits:
    """Measured rates in float32, with the threads that torch uses.

    Args:
        exp: elements per second of ``torch.exp`` in cache.
        exp2: elements per second of ``torch.exp2`` in cache.
        copy: bytes per second, read plus written, of a copy from memory to memory.
    """

    exp: float
    exp2: float
    copy: float


def measure_limits(device: torch.device, *, repeats: int = 7) -> Limits:
    """Measure the limits: the fastest of the repetitions, because what slowed down the others is no limit."""
    x = -5 * torch.rand(_CACHED_CPU if device.type == "cpu" else _CACHED_CUDA, device=device)
    out = torch.empty_like(x)
    source = torch.ones(_LARGE, device=device)
    target = torch.empty_like(source)

    def many(function: Callable[[], object]) -> None:
        for _ in range(_CALLS):
            function()

    seconds = in_turns(
        {
            "exp": lambda: many(lambda: torch.exp(x, out=out)),
            "exp2": lambda: many(lambda: torch.exp2(x, out=out)),
            "copy": lambda: target.copy_(source),
        },
        repeats,
        device,
    )
    work = {"exp": _CALLS * x.numel(), "exp2": _CALLS * x.numel(), "copy": 2 * source.numel() * source.element_size()}
    return Limits(**{name: work[name] / min(seconds[name]) for name in work})


def bounds(limits: Limits, workload: Workload, pairs: int) -> dict[str, float]:
    """Return lower bounds on the time of a rendering, seconds.

    Args:
        limits: of the machine.
        workload: what is rendered, float32.
        pairs: as `covered_pairs` counts them.

    Returns:
        "exp": one exponential per pair at the faster of the two rates. "copy": every parameter read and every pixel
        written once, at the rate of a copy. Forward plus backward cannot be faster than either; if it evaluates the
        alphas again, not faster than twice the former.
    """
    values = sum(x.numel() * x.element_size() for x in (*workload.parameters.values(), workload.target))
    return {"exp": pairs / max(limits.exp, limits.exp2), "copy": values / limits.copy}


@torch.no_grad()
def covered_pairs(workload: Workload) -> int:
    """Count the pairs of a pixel and a Gaussian whose alpha there is at least 1/255, hidden ones included.

    Exact in float64 up to pairs on the edge: an ellipse covers an interval of every row of pixels. All Gaussians must
    lie in front of the camera.

    Example:
        >>> from reference_trainer.studies.speed.workloads import WORKLOADS
        >>> small = WORKLOADS["small"].make()
        >>> round(covered_pairs(small) / (128 * 128))
        45
    """
    precise = workload.to("cpu", torch.float64)
    camera = precise.camera
    projection = project(precise.means, precise.quaternions, precise.scales, camera)
    (x, y), (l11, l21, l22) = projection.means.unbind(1), projection.factors.unbind(1)
    squared_radius = 2 * torch.log(precise.opacities / _MIN_ALPHA).clamp(min=0)
    reach = squared_radius.sqrt() / l22
    first = torch.ceil(y - reach - 0.5).clamp(min=0)
    rows = (torch.floor(y + reach - 0.5).clamp(max=camera.height - 1) - first + 1).clamp(min=0).long()
    of = torch.repeat_interleave(rows)
    row = first[of] + torch.arange(of.shape[0]) - (rows.cumsum(0) - rows)[of]
    dy = row + 0.5 - y[of]
    half = (squared_radius[of] - (l22[of] * dy) ** 2).clamp(min=0).sqrt() / l11[of]
    middle = x[of] - l21[of] / l11[of] * dy
    begin = torch.ceil(middle - half - 0.5).clamp(min=0)
    end = torch.floor(middle + half - 0.5).clamp(max=camera.width - 1)
    return int((end - begin + 1).clamp(min=0).sum().item())
