"""Work and precision of the estimators of co-adaptation: their error against the wall-clock time."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ca_reg.functional import Multiplier, apply_dropout, draw_keep_mask
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render import first_order_map
from reference_trainer.scenes.scene import View
from reference_trainer.studies.engines import drawn_by, engines_on
from reference_trainer.studies.timing import in_turns, now

__all__ = [
    "DOUBLE",
    "ERRORS",
    "FIRST_ORDER",
    "LOOPS",
    "MONTE_CARLO",
    "TORCH",
    "Error",
    "ErrorRuntime",
    "Measurement",
    "error_runtime",
]

MONTE_CARLO = "Monte Carlo"
FIRST_ORDER = "first order"
LOOPS = "exact, loops"
TORCH = "exact, torch"
DOUBLE = "exact float64"

Error = Literal["score", "map"]
ERRORS: tuple[Error, ...] = ("score", "map")

DROP_RATE = 0.5
THRESHOLD = 0.8  # of the expected alpha
ROUNDS = 7  # how often everything but Monte Carlo is timed
FIT_FROM = 8  # smallest K of the fitted lines: at smaller ones the error is not yet a power of K


@dataclass(frozen=True)
class Measurement:
    """One estimator at one price.

    Args:
        estimator: its name.
        samples: number of renders K of a Monte Carlo estimate, else None.
        seconds: wall-clock times, one per seed or repetition.
        scores: estimated scores, one per seed; one if there is nothing random.
        score_errors: of each, ``|score - reference| / reference``.
        map_errors: root mean square of the error of the variance map, divided by the mean of the reference.
    """

    estimator: str
    samples: int | None
    seconds: list[float]
    scores: list[float]
    score_errors: list[float]
    map_errors: list[float]

    def rms(self, error: Error) -> float:
        """Return the root mean square of an error over the seeds."""
        return math.sqrt(fmean(x * x for x in self.errors(error)))

    def errors(self, error: Error) -> list[float]:
        """Return an error of every seed."""
        return self.score_errors if error == "score" else self.map_errors


@dataclass(frozen=True)
class ErrorRuntime:
    """Error against time for one model and view. The reference is the exact float64 result.

    Args:
        view: name of the view.
        width: of the picture, pixels.
        height: of the picture, pixels.
        gaussians: number of them.
        covered: share of the pixels in the region, in which the expected alpha exceeds 0.8.
        drop_rate: of the masks.
        score: the reference: the exact variance, mean over RGB and over the region.
        render_seconds: times of a plain render in float32, one per repetition.
        measurements: of all estimators.
    """

    view: str
    width: int
    height: int
    gaussians: int
    covered: float
    drop_rate: float
    score: float
    render_seconds: list[float]
    measurements: list[Measurement]

    def slope(self, error: Error) -> float:
        """Return the slope of ln error against ln K, fitted to Monte Carlo from K = 8 on; expected is -1/2.

        The error at one K is the root mean square over the seeds. A map has the errors of many pixels, the score one
        error per seed: the slope of the latter scatters, with a deviation of 0.14 for 3 seeds and K up to 1024.
        """
        ks, errors = self._convergence(error)
        return float(np.polyfit(np.log(ks), np.log(errors), 1)[0])

    def samples_to_match(self, error: Error) -> float | None:
        """Return the K at which Monte Carlo would have the error of the first exact float32 estimate.

        Extrapolated from the measured errors by the law K^(-1/2) and not by the fitted slope, whose uncertainty would
        be multiplied by many decades. The renders' own rounding and early stop may keep the average from getting
        there. None if the exact estimate has no error at all.
        """
        ks, errors = self._convergence(error)
        target = self.single.rms(error)
        return float(np.exp(np.mean(np.log(ks * errors**2)))) / target**2 if target > 0 else None

    def _convergence(self, error: Error) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return K and the error of Monte Carlo at each."""
        points = [(m.samples, m.rms(error)) for m in self.measurements if m.samples and m.samples >= FIT_FROM]
        ks, errors = np.array(points, dtype=np.float64).T
        return ks, errors

    @property
    def single(self) -> Measurement:
        """The exact float32 estimate of the loops, or of torch where there are none."""
        return next(m for m in self.measurements if m.estimator in (LOOPS, TORCH))

    def of(self, estimator: str) -> Measurement:
        """Return the first measurement of an estimator."""
        return next(m for m in self.measurements if m.estimator == estimator)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data, with the fitted slopes, for JSON."""
        fits = {
            error: {"slope": self.slope(error), "samples_to_match_exact_float32": self.samples_to_match(error)}
            for error in ERRORS
        }
        return {**asdict(self), "fits": fits}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ErrorRuntime:
        """Return what `as_dict` wrote; unknown entries are ignored."""
        known = {name: data[name] for name in cls.__dataclass_fields__}
        return cls(**{**known, "measurements": [Measurement(**m) for m in data["measurements"]]})


@torch.no_grad()
def error_runtime(
    model: TrainedModel,
    view: View,
    *,
    max_samples: int = 1024,
    seeds: int = 3,
    progress: Callable[[str], None] | None = None,
) -> ErrorRuntime:
    """Measure error and wall-clock time of all estimators of the co-adaptation of one view at a drop rate of 1/2.

    - Monte Carlo with K = 2, 4, 8, ... renders: the unbiased variance (ddof = 1), accumulated in float64 in one running
      pass per seed. Its time includes drawing the masks.
    - The paper's first-order form, and the exact moments in float32, drawn by every engine, and in float64.

    All share one region, the pixels whose expected alpha exceeds 0.8 in the exact float64 result, and every time starts
    at the parameters of the model: projection and tile lists are included. Each call is made once before it is timed;
    on a GPU the clock waits for the work to be done. What takes one call is timed in turns with the plain render, so
    that a change of the machine's load meets all of them. Plain renders are drawn by the engine that is chosen.

    Args:
        model: what to measure, float32; its dropout rate does not matter.
        view: what to render; only its name and camera matter.
        max_samples: largest K, a power of two, at least 16.
        seeds: number of Monte Carlo runs, at least 1; their masks come from the seeds 0, 1, 2, ...
        progress: receives a line before each part.

    Returns:
        All measurements; errors are relative to the exact float64 result, whose own are 0 by definition.

    Raises:
        ValueError: if an argument is out of range, no pixel is covered, or nothing in the region varies.
    """
    if max_samples < 2 * FIT_FROM or max_samples & (max_samples - 1) or seeds < 1:
        raise ValueError(
            f"expected max_samples, a power of two of at least {2 * FIT_FROM}, and at least 1 seed, got {max_samples} "
            f"and {seeds}."
        )
    tell = progress or (lambda text: None)
    double = replace(model, gaussians=model.gaussians.map(Tensor.double), background=model.background.double())
    multiplier = Multiplier.dropout(DROP_RATE)
    opacities, precise = model.gaussians.opacities, double.gaussians.opacities
    device = opacities.device

    exact = double.moments(precise, view, multiplier)
    assert exact.alpha_mean is not None
    region = exact.alpha_mean > THRESHOLD
    if not bool(region.any()):
        raise ValueError(
            f"no pixel of {view.name} has an expected alpha above {THRESHOLD}: the camera looks past the model, or the "
            "model is nearer than the near plane."
        )
    reference = exact.variance.mean(0)[region]
    score = reference.mean().item()
    if not score > 0:
        raise ValueError(f"nothing varies in the covered part of {view.name}: relative errors do not exist.")

    def errors(variance: Tensor) -> tuple[float, float, float]:
        estimate = variance.double().mean(0)[region]
        found = estimate.mean().item()
        rms = (estimate - reference).square().mean().sqrt().item()
        return found, abs(found - score) / score, rms / score

    def moments(engine: str) -> Tensor:
        with drawn_by(engine):
            return model.moments(opacities, view, multiplier).variance

    exact_calls = {f"exact, {engine}": functools.partial(moments, engine) for engine in engines_on(device)}
    calls: dict[str, Callable[[], Tensor]] = {
        "render": lambda: model.render(opacities, view)[0],
        FIRST_ORDER: lambda: first_order_map(model.splats(opacities, view), multiplier),
        **exact_calls,
        DOUBLE: lambda: double.moments(precise, view, multiplier).variance,
    }
    tell(f"render, {', '.join(list(calls)[1:])}")
    maps = {name: call() for name, call in calls.items()}
    seconds = in_turns(calls, ROUNDS, functools.partial(now, device))
    runs = []
    for seed in range(seeds):
        tell(f"{MONTE_CARLO}, {max_samples} renders, seed {seed}")
        runs.append([(k, spent, *errors(v)) for k, spent, v in _monte_carlo(model, view, max_samples, seed)])
    sampled = []
    for of_k in zip(*runs, strict=True):
        ks, *columns = (list(column) for column in zip(*of_k, strict=True))
        sampled.append(Measurement(MONTE_CARLO, ks[0], *columns))
    single = [Measurement(name, None, seconds[name], *([x] for x in errors(maps[name]))) for name in list(calls)[1:]]
    return ErrorRuntime(
        view=view.name,
        width=view.camera.width,
        height=view.camera.height,
        gaussians=len(model.gaussians),
        covered=region.double().mean().item(),
        drop_rate=DROP_RATE,
        score=score,
        render_seconds=seconds["render"],
        measurements=[*sampled, *single],
    )


def _monte_carlo(model: TrainedModel, view: View, max_samples: int, seed: int) -> Iterator[tuple[int, float, Tensor]]:
    """Yield K = 2, 4, 8, ..., the seconds spent up to there, and the unbiased variance (3, H, W)."""
    opacities = model.gaussians.opacities
    device = opacities.device
    generator = torch.Generator().manual_seed(seed)
    mean = scatter = torch.zeros((), dtype=torch.float64, device=device)
    count, spent, target = 0, 0.0, 2
    while target <= max_samples:
        start = now(device)
        while count < target:
            keep = draw_keep_mask(len(model.gaussians), DROP_RATE, generator=generator, device=device)
            image = model.render(apply_dropout(opacities, keep), view)[0].double()
            count += 1
            deviation = image - mean
            mean = mean + deviation / count
            scatter = scatter + deviation * (image - mean)
        spent += now(device) - start
        yield count, spent, scatter / (count - 1)
        target *= 2
