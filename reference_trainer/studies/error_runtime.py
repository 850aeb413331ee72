"""Work-precision study of the estimators of co-adaptation: error against wall-clock time."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ca_reg.functional import Multiplier, apply_dropout, draw_keep_mask
from reference_trainer.evaluation.metrics import first_order_map
from reference_trainer.evaluation.style import COLORS, WIDTH, readable
from reference_trainer.evaluation.tables import format_mean_std, markdown_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import is_ply
from reference_trainer.render.engine import engines_on, using_engine
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.ply import load_plain_ply_model
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import orbit_views
from reference_trainer.studies.study import Record, Records, Study, checkpoints, in_turns, now

__all__ = ["entries_of", "error_runtime", "error_runtime_study", "rms", "samples_to_match", "single", "slope"]

MONTE_CARLO, FIRST_ORDER, DOUBLE = "Monte Carlo", "first order", "exact float64"
LOOPS, TORCH = "exact, numba", "exact, torch"
ERRORS = ("score", "map")

DROP_RATE = 0.5
THRESHOLD = 0.8  # of the expected alpha
ROUNDS = 7  # how often everything but Monte Carlo is timed
FIT_FROM = 8  # smallest K of the fitted lines: below, the error does not yet follow a power law in K
IMAGE_SIDE = 256  # pixels, of the image of a PLY


def error_runtime_study(
    sources: Sequence[Path],
    *,
    max_samples: int = 1024,
    seeds: int = 3,
    device: str = "cpu",
    trust: Collection[str] = (),
) -> Study:
    """Declare the study for runs of this package, by their folders, and for any PLY files.

    A run is measured at its first test view, or training view if there is none; a PLY at the first camera of an orbit,
    over black. Both use the plain opacities: CA is defined without the test-time scaling. ``max_samples`` is the
    largest K, a power of two of at least 16; ``seeds`` the number of Monte Carlo runs; ``trust`` is as for `load_run`.

    Raises:
        FileNotFoundError: if a folder holds no run.
        ValueError: if there is no source, two have the same name, or a number is out of range.
    """
    if max_samples < 2 * FIT_FROM or max_samples & (max_samples - 1) or seeds < 1:
        raise ValueError(
            f"expected max_samples, a power of two of at least {2 * FIT_FROM}, and at least 1 seed, got {max_samples} "
            f"and {seeds}."
        )
    plys = [source for source in sources if is_ply(source)]
    runs = [source for source in sources if not is_ply(source)]
    named = {**(checkpoints(runs) if runs or not plys else {}), **{ply.stem: ply for ply in plys}}
    if len(named) < len({*sources}) or len({*plys}) < len(plys):
        raise ValueError(f"sources must have different names, got {[str(source) for source in sources]}.")
    settings = {"max_samples": max_samples, "seeds": seeds, "device": device}
    cases = {name: {"source": source, **settings} for name, source in named.items()}
    return Study("error_runtime", functools.partial(_measure, trust=tuple(trust)), cases, _report, _plot)


def _measure(source: Path, max_samples: int, seeds: int, device: str, trust: Collection[str]) -> Record:
    """Measure one source: the checkpoint of a run, or a PLY."""
    view: Viewpoint
    if is_ply(source):
        model, _ = load_plain_ply_model(source, device=device, trust=trust)
        means, opacities = model.gaussians.means, model.gaussians.opacities
        (camera,) = orbit_views(means, opacities, count=1, width=IMAGE_SIDE, height=IMAGE_SIDE)
        view = Viewpoint("orbit", camera)
    else:
        model, scene = load_run_model(source.parent, device, trust=trust)
        view = (*scene.test, *scene.train)[0].to(device)
    return error_runtime(model, view, max_samples=max_samples, seeds=seeds)


@torch.no_grad()
def error_runtime(model: TrainedModel, view: Viewpoint, *, max_samples: int = 1024, seeds: int = 3) -> Record:
    """Measure error and wall-clock time of all estimators of one view's co-adaptation at drop rate 1/2.

    - Monte Carlo with K = 2, 4, 8, ... up to ``max_samples`` renders, for so many ``seeds``: the unbiased variance
      (ddof = 1), accumulated in float64 in one running pass per seed. Its time includes drawing the masks.
    - The paper's first-order form, and the exact moments in float32, rendered by every engine, and in float64.

    All share one region, the pixels whose expected alpha exceeds 0.8 in the exact float64 result. Times start from the
    parameters of the float32 model, so they include projection and tile lists; on a GPU the clock waits for the work to
    be done. Everything but Monte Carlo is called once untimed and then timed in turns with the plain render
    (`in_turns`), which is rendered by the engine in use, as are the Monte Carlo renders.

    Returns:
        The exact float64 ``score``, the mean over RGB and the region, which covers the share ``covered`` of the pixels;
        ``render_seconds`` of a plain render; under ``estimators`` one entry per estimator and K with ``seconds``,
        ``scores``, ``score`` and ``map``, a value for each seed or repetition. ``score`` is the relative error of the
        score, ``map`` the root mean square error of the variance map, divided by the mean of the reference.

    Raises:
        ValueError: if no pixel is covered, or nothing in the region varies.
    """
    # The same float32 parameters, computed with in float64: what is left is the error of the arithmetic.
    double = replace(model, gaussians=model.gaussians.map(Tensor.double), background=model.background.double())
    multiplier = Multiplier.dropout(DROP_RATE)
    opacities, precise = model.gaussians.opacities, double.gaussians.opacities
    device = opacities.device

    exact = double.moments(precise, view, multiplier)
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
        return found, abs(found - score) / score, (estimate - reference).square().mean().sqrt().item() / score

    def moments(engine: str) -> Tensor:
        with using_engine(engine):
            return model.moments(opacities, view, multiplier).variance

    exact_calls = {f"exact, {engine}": functools.partial(moments, engine) for engine in engines_on(device)}
    calls: dict[str, Callable[[], Tensor]] = {
        "render": lambda: model.render(opacities, view)[0],
        FIRST_ORDER: lambda: first_order_map(model.splats(opacities, view), multiplier),
        **exact_calls,
        DOUBLE: lambda: double.moments(precise, view, multiplier).variance,
    }
    # This is also the untimed round, in which engines compile and caches fill.
    maps = {name: call() for name, call in calls.items()}
    seconds = in_turns(calls, ROUNDS, functools.partial(now, device))
    of_seeds = [
        [(k, spent, *errors(variance)) for k, spent, variance in _monte_carlo(model, view, max_samples, seed)]
        for seed in range(seeds)
    ]

    def entry(name: str, k: int | None, spent: list[float], measured: Sequence[tuple[float, ...]]) -> Record:
        scores, score_errors, map_errors = ([*column] for column in zip(*measured, strict=True))
        return {"name": name, "K": k, "seconds": spent, "scores": scores, "score": score_errors, "map": map_errors}

    sampled = [
        entry(MONTE_CARLO, at_k[0][0], [x[1] for x in at_k], [x[2:] for x in at_k])
        for at_k in zip(*of_seeds, strict=True)
    ]
    others = [entry(name, None, seconds[name], [errors(maps[name])]) for name in list(calls)[1:]]
    return {
        "view": view.name,
        "width": view.camera.width,
        "height": view.camera.height,
        "gaussians": len(model.gaussians),
        "covered": region.double().mean().item(),
        "drop_rate": DROP_RATE,
        "score": score,
        "render_seconds": seconds["render"],
        "estimators": [*sampled, *others],
    }


def _monte_carlo(
    model: TrainedModel, view: Viewpoint, max_samples: int, seed: int
) -> Iterator[tuple[int, float, Tensor]]:
    """Yield K = 2, 4, 8, ..., the seconds spent so far, and the unbiased variance (3, H, W)."""
    opacities = model.gaussians.opacities
    device = opacities.device
    generator = torch.Generator().manual_seed(seed)
    mean = scatter = torch.zeros((), dtype=torch.float64, device=device)
    count, spent, target = 0, 0.0, 2
    while target <= max_samples:
        start = now(device)
        # One pass serves all K: the first renders of a larger K are those of the smaller ones.
        while count < target:
            keep = draw_keep_mask(len(model.gaussians), DROP_RATE, generator=generator, device=device)
            image = model.render(apply_dropout(opacities, keep), view)[0].double()
            count += 1
            # Welford's recursion: a sum of squares less the square of a sum would cancel.
            deviation = image - mean
            mean = mean + deviation / count
            scatter = scatter + deviation * (image - mean)
        spent += now(device) - start
        yield count, spent, scatter / (count - 1)
        target *= 2


def rms(estimate: Record, error: str) -> float:
    """Return the root mean square over the seeds of an estimate's error, one of `ERRORS`."""
    return math.sqrt(statistics.fmean(x * x for x in estimate[error]))


def entries_of(record: Record, name: str) -> list[Record]:
    """Return the entries of an estimator, by K."""
    return [estimate for estimate in record["estimators"] if estimate["name"] == name]


def single(record: Record) -> Record:
    """Return the exact float32 estimate of the loops, or of the torch engine if there is none."""
    return (entries_of(record, LOOPS) or entries_of(record, TORCH))[0]


def slope(record: Record, error: str) -> float:
    """Return the slope of ln error against ln K, fitted to Monte Carlo from K = 8 on; expected is -1/2.

    The error at one K is the root mean square over the seeds. A map averages the errors of many pixels, but the score
    has one error per seed, so its slope scatters: by 0.14 (standard deviation) for 3 seeds and K up to 1024.
    """
    ks, errors = _convergence(record, error)
    return float(np.polyfit(np.log(ks), np.log(errors), 1)[0])


def samples_to_match(record: Record, error: str) -> float | None:
    """Return the K at which Monte Carlo would reach the error of the exact float32 estimate, see `single`.

    Extrapolated from the measured errors by the law K^(-1/2), not by the fitted slope, whose uncertainty would be
    magnified over many decades. Rounding and early termination in the renders may keep the average from getting there.
    None if the exact estimate has no error at all.
    """
    ks, errors = _convergence(record, error)
    target = rms(single(record), error)
    return float(np.exp(np.mean(np.log(ks * errors**2)))) / target**2 if target > 0 else None


def _convergence(record: Record, error: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the K of the fit and the Monte Carlo error at each."""
    points = [(m["K"], rms(m, error)) for m in entries_of(record, MONTE_CARLO) if m["K"] >= FIT_FROM]
    ks, errors = np.array(points, dtype=np.float64).T
    return ks, errors


def _report(records: Records) -> str:
    return "\n".join(f"## {name}\n\n{_table(record)}" for name, record in records.items())


def _table(record: Record) -> str:
    """Return one row per estimator, and conclusions; times are medians, errors root mean squares over the seeds."""
    render = statistics.median(record["render_seconds"])
    rows: list[dict[str, object]] = []
    for m in record["estimators"]:
        seconds = statistics.median(m["seconds"])
        row = {"estimator": m["name"], "K": m["K"] or "", "seconds": seconds, "renders": f"{seconds / render:.3g}"}
        row["score x1e-3"] = format_mean_std(m["scores"], unit=1e-3)
        rows.append(row | {f"{error} error": f"{rms(m, error):.2g}" for error in ERRORS})
    return (
        f"{markdown_table(rows, list(rows[0]))}\n"
        f"View {record['view']}, {record['width']}x{record['height']}, {record['gaussians']} Gaussians; the region "
        f"covers {record['covered']:.0%} of the pixels. Drop rate {record['drop_rate']:g}. One plain render takes "
        f"{render:.3g} s; errors are relative to exact float64.\n\n"
        + "".join(f"- {_conclusion(record, error)}\n" for error in ERRORS)
    )


def _conclusion(record: Record, error: str) -> str:
    """Say how the Monte Carlo error falls, and when it would reach that of the exact estimate."""
    needed, name, last = samples_to_match(record, error), single(record)["name"], entries_of(record, MONTE_CARLO)[-1]
    text = f"{error}: the error of {MONTE_CARLO} falls as K^{slope(record, error):.2f}"
    if needed is None:
        return f"{text}; {name} has none."
    hours = needed / last["K"] * statistics.median(last["seconds"]) / 3600
    return f"{text}; continued as K^-0.5 it equals that of {name} at K = {needed:.1e}, after {hours:.1e} hours."


def _plot(records: Records, figure: Any) -> None:
    """Plot error against time, one panel per model; bars span the smallest to the largest error of a seed."""
    figure.set_size_inches(WIDTH, 5.6)
    panels = figure.subplots(1, len(records), squeeze=False, sharey=True)[0]
    for axes, (name, record) in zip(panels, records.items(), strict=True):
        _panel(axes, record)
        axes.set_title(readable(name.rsplit("/", 1)[-1]))
    panels[0].set_ylabel("relative error")
    lines = dict(zip(*reversed(panels[-1].get_legend_handles_labels()), strict=True))
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)


def _panel(axes: Any, record: Record) -> None:
    """Plot one model: filled markers for the score, hollow ones for the map."""
    styles = dict(zip((MONTE_CARLO, FIRST_ORDER, LOOPS, TORCH), zip("osD^", COLORS, strict=False), strict=True))
    for error in ERRORS:
        for name, (marker, color) in styles.items():
            measured = [m for m in entries_of(record, name) if rms(m, error) > 0]
            if measured:
                centers = [rms(m, error) for m in measured]
                pairs = list(zip(centers, measured, strict=True))
                axes.errorbar(
                    [statistics.median(m["seconds"]) for m in measured],
                    centers,
                    yerr=[[y - min(m[error]) for y, m in pairs], [max(m[error]) - y for y, m in pairs]],
                    label=f"{name}, {error}",
                    marker=marker,
                    markerfacecolor=color if error == "score" else "white",
                    color=color,
                    linestyle="-" if error == "score" else "--",
                    markersize=5,
                    linewidth=1,
                    capsize=2,
                )
    # A line, not a point: the error of the reference is 0, for which a logarithmic axis has no place.
    precise = statistics.median(entries_of(record, DOUBLE)[0]["seconds"])
    axes.axvline(precise, color="0.3", linestyle=":", label=f"{DOUBLE} (reference)")
    axes.set(xscale="log", yscale="log", xlabel="wall-clock time, s")
    axes.tick_params(which="minor", labelbottom=False)
    render = statistics.median(record["render_seconds"])
    top = axes.secondary_xaxis("top", functions=(lambda s: s / render, lambda n: n * render))
    top.set_xlabel("wall-clock time, plain renders")
    top.tick_params(which="minor", labeltop=False)
    sampled = entries_of(record, MONTE_CARLO)
    for m in (sampled[0], sampled[-1]):
        place = (statistics.median(m["seconds"]), rms(m, "map"))
        axes.annotate(f"K = {m['K']}", place, (0, 9), textcoords="offset points", ha="center", fontsize="small")
