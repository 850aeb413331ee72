"""Everything that is measured on one workload."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from reference_trainer.studies.speed.calls import BASELINE, SUBJECT, gradients, image
from reference_trainer.studies.speed.gsplat import gsplat_calls
from reference_trainer.studies.speed.limits import Limits, bounds, covered_pairs
from reference_trainer.studies.speed.memory import peak_memory
from reference_trainer.studies.speed.stages import STAGES, Staged, staged
from reference_trainer.studies.speed.steps import MASKS, masked_renders
from reference_trainer.studies.speed.workloads import WorkloadSpec
from reference_trainer.studies.timing import in_turns

__all__ = ["PASSES", "WorkloadSpeed", "measure_workload"]

PASSES = ("forward", "forward+backward")
_GRADIENTS_UP_TO = 2_000  # Gaussians: the reference keeps every pair in float64


@dataclass(frozen=True)
class WorkloadSpeed:
    """What was measured on one workload.

    Args:
        gaussians: number of them.
        width: of the picture, pixels.
        height: of the picture, pixels.
        pairs: of a pixel and a Gaussian with an alpha of at least 1/255.
        evaluated: pairs that the renderer evaluates.
        bounds: lower bounds on the time, seconds, see `limits.bounds`.
        seconds: of every repetition, by what was timed.
        stages: seconds of every repetition, by stage.
        memory: peak above the inputs, bytes, by pass; None where the system does not tell.
        image_error: absolute, against float64: "mean" and "max" over pixels and channels.
        gradient_errors: norm of the error over the norm, against float64, by parameter; None for larger workloads.
    """

    gaussians: int
    width: int
    height: int
    pairs: int
    evaluated: int
    bounds: dict[str, float]
    seconds: dict[str, list[float]]
    stages: dict[str, list[float]]
    memory: dict[str, int] | None
    image_error: dict[str, float]
    gradient_errors: dict[str, float] | None

    def median(self, what: str) -> float:
        """Return the median time of something, seconds."""
        return statistics.median(self.seconds[what])

    def ratios(self) -> dict[str, float]:
        """Return times in units of others that were taken in turns with them: medians of the quotients per round."""
        pairs = {f"{x} / baseline": (x, f"baseline {x}") for x in PASSES}
        pairs |= {f"{x} / gsplat": (x, f"gsplat {x}") for x in PASSES if f"gsplat {x}" in self.seconds}
        pairs[f"score of {MASKS} / {MASKS} renders"] = (f"score of {MASKS}", f"{MASKS} renders")
        return {
            name: statistics.median(a / b for a, b in zip(self.seconds[x], self.seconds[y], strict=True))
            for name, (x, y) in pairs.items()
        }

    def errors(self) -> dict[str, float]:
        """Return all errors by name."""
        images = {f"image, {name}": error for name, error in self.image_error.items()}
        return images | {f"gradient of {name}": error for name, error in (self.gradient_errors or {}).items()}

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data, with what follows from it, for JSON."""
        return {
            **asdict(self),
            "medians": {name: self.median(name) for name in self.seconds},
            "stage_medians": {name: statistics.median(seconds) for name, seconds in self.stages.items()},
            "ratios": self.ratios(),
            "errors": self.errors(),
            "ratios_to_limits": {
                f"{x} / {name} bound": self.median(x) / bound for x in PASSES for name, bound in self.bounds.items()
            },
            "pairs_per_second": {x: self.pairs / self.median(x) for x in PASSES},
            "stages_over_whole": sum(map(statistics.median, self.stages.values())) / self.median(PASSES[1]),
        }


def measure_workload(spec: WorkloadSpec, limits: Limits, *, repeats: int, device: torch.device) -> WorkloadSpeed:
    """Measure the renderer and the baseline on one workload.

    Args:
        spec: of the workload.
        limits: of the machine.
        repeats: number of timed rounds; in each, everything is timed once.
        device: where to render.
    """
    workload = spec.make().to(device)
    precise = workload.to(dtype=torch.float64)
    difference = (image(SUBJECT, workload).double() - image(BASELINE, precise)).abs()
    gradient_errors = None
    if spec.gaussians <= _GRADIENTS_UP_TO:
        found, true = gradients(SUBJECT, workload), gradients(BASELINE, precise)
        gradient_errors = {name: _relative(found[name], true[name]) for name in true}
    pairs = covered_pairs(workload)
    runs: list[Staged] = []
    calls: dict[str, Callable[[], object]] = {
        PASSES[0]: lambda: image(SUBJECT, workload),
        f"baseline {PASSES[0]}": lambda: image(BASELINE, workload),
        PASSES[1]: lambda: gradients(SUBJECT, workload),
        f"baseline {PASSES[1]}": lambda: gradients(BASELINE, workload),
        "stages": lambda: runs.append(staged(workload)),
        **masked_renders(workload),
        **gsplat_calls(workload),
    }
    seconds = in_turns(calls, repeats, device)
    return WorkloadSpeed(
        gaussians=spec.gaussians,
        width=spec.width,
        height=spec.height,
        pairs=pairs,
        evaluated=runs[0].evaluated,
        bounds=bounds(limits, workload, pairs),
        seconds=seconds,
        stages={name: [run.seconds[name] for run in runs[-repeats:]] for name in STAGES},
        memory=peak_memory(spec, device),
        image_error={"mean": difference.mean().item(), "max": difference.max().item()},
        gradient_errors=gradient_errors,
    )


def _relative(found: Tensor, true: Tensor) -> float:
    """Return the norm of an error relative to that of the true value."""
    return float((found.double() - true).norm() / true.norm())
