"""The work-precision diagram over several models: table, figure, and a study that continues where it was."""

from __future__ import annotations

import hashlib
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from reference_trainer.evaluation.results import format_mean_std, machine, markdown_table, write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import replacing, write_text
from reference_trainer.json_files import read_json
from reference_trainer.model.ply import load_ply
from reference_trainer.render import describe_engine
from reference_trainer.runs.measure import of_run
from reference_trainer.scenes.orbit import orbit_views
from reference_trainer.scenes.scene import View
from reference_trainer.studies.engines import engines_on
from reference_trainer.studies.error_runtime import (
    DOUBLE,
    ERRORS,
    FIRST_ORDER,
    LOOPS,
    MONTE_CARLO,
    TORCH,
    Error,
    ErrorRuntime,
    error_runtime,
)

__all__ = ["error_runtime_figure", "error_runtime_table", "study", "study_error_runtime"]

REPORT = "error_runtime.json"
TABLE = "error_runtime.md"
FIGURE = "error_runtime.png"
PICTURE = 256  # side of the picture of a PLY, pixels

Say = Callable[[str], None]


def study_error_runtime(
    sources: Sequence[Path],
    out: Path,
    *,
    max_samples: int = 1024,
    seeds: int = 3,
    device: str = "cpu",
    say: Say = print,
) -> dict[str, ErrorRuntime]:
    """Study runs of this program and anyone's PLY files.

    A run is measured at its first test view, or training view if there is none; a PLY at the first camera of an orbit,
    over black. Both with the plain opacities: the test-time scaling is no part of co-adaptation.

    Args:
        sources: folders of runs, and ``.ply`` files.
        out: folder for the results.
        max_samples: largest K.
        seeds: number of Monte Carlo runs.
        device: where to render.
        say: receives the progress and the tables.

    Returns:
        The results by name: a PLY's file name without extension, the last three parts of a run's path.

    Raises:
        FileNotFoundError: if a source is missing, or is no run.
        ValueError: if two sources have the same name, a PLY is damaged or its opacities are scaled already, or as
            `error_runtime`.
    """
    models: dict[str, tuple[TrainedModel, View]] = {}
    for source in sources:
        is_ply = source.suffix == ".ply"
        name = source.stem if is_ply else "/".join(source.resolve().parts[-3:])
        if name in models:
            raise ValueError(f"two sources are called {name}: rename one, or study them in different folders.")
        models[name] = _of_ply(source, device) if is_ply else _of_run(source, device)
    return study(models, out, max_samples=max_samples, seeds=seeds, say=say)


def study(
    models: Mapping[str, tuple[TrainedModel, View]],
    out: Path,
    *,
    max_samples: int = 1024,
    seeds: int = 3,
    say: Say = print,
) -> dict[str, ErrorRuntime]:
    """Measure every model, and write ``error_runtime.json``, ``.md`` and ``.png``.

    Each finished scene is written at once. A scene that is in the JSON file already, of the same model and view and
    with the same settings, threads and device, is not measured again; other scenes in the file are kept.

    Args:
        models: model and view by name of the scene, on the same device.
        out: folder for the results.
        max_samples: largest K.
        seeds: number of Monte Carlo runs.
        say: receives the progress and the tables.

    Returns:
        The results by name.

    Raises:
        ValueError: if there is no model, or as `error_runtime`.
    """
    if not models:
        raise ValueError("a study needs at least one model, got none.")

    def progress(scene: str) -> Say:
        return lambda text: say(f"{scene}: {text}")

    file = out / REPORT
    scenes: dict[str, Any] = read_json(file) if file.exists() else {}
    results: dict[str, ErrorRuntime] = {}
    for name, (model, view) in models.items():
        settings = _settings(model, view, max_samples, seeds)
        if scenes.get(name, {}).get("settings") == settings:
            say(f"{name}: measured before, kept")
        else:
            result = error_runtime(model, view, max_samples=max_samples, seeds=seeds, progress=progress(name))
            scenes[name] = {"settings": settings, **result.as_dict(), "machine": machine()}
            write_json(file, scenes)
        results[name] = ErrorRuntime.from_dict(scenes[name])
    text = "\n".join(f"## {name}\n\n{error_runtime_table(result)}" for name, result in results.items())
    write_text(out / TABLE, text)
    error_runtime_figure(results, out / FIGURE)
    say(text)
    say(f"numbers, tables and figure: {file}, {out / TABLE}, {out / FIGURE}")
    return results


def error_runtime_table(result: ErrorRuntime) -> str:
    """Return one row per estimator in Markdown, and what follows from them.

    Times are medians; errors are root mean squares over the seeds.
    """
    render = statistics.median(result.render_seconds)
    rows: list[dict[str, object]] = []
    for m in result.measurements:
        seconds = statistics.median(m.seconds)
        rows.append(
            {
                "estimator": m.estimator,
                "K": "" if m.samples is None else m.samples,
                "seconds": seconds,
                "renders": f"{seconds / render:.3g}",
                "score x1e-3": format_mean_std(m.scores, unit=1e-3),
                "score error": f"{m.rms('score'):.2g}",
                "map error": f"{m.rms('map'):.2g}",
            }
        )
    conclusions = [_conclusion(result, error) for error in ERRORS]
    return "\n".join(
        [
            markdown_table(rows, list(rows[0])),
            f"View {result.view}, {result.width}x{result.height}, {result.gaussians} Gaussians; the region covers "
            f"{result.covered:.0%} of the pixels. Drop rate {result.drop_rate:g}. One plain render takes {render:.3g} "
            "s; errors are relative to exact float64.",
            "",
            *(f"- {text}" for text in conclusions),
            "",
        ]
    )


def error_runtime_figure(results: Mapping[str, ErrorRuntime], path: Path) -> None:
    """Draw error against time, one panel per scene; bars reach from the smallest to the largest error of a seed.

    Args:
        results: by the title of the panel.
        path: the PNG to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(results), 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(results), squeeze=False, sharey=True)[0]
    for axes, (name, result) in zip(panels, results.items(), strict=True):
        _panel(axes, result)
        axes.set_title(name, fontsize="medium")
    panels[0].set_ylabel("relative error")
    lines = dict(zip(*reversed(panels[-1].get_legend_handles_labels()), strict=True))
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format="png")


def _panel(axes: Any, result: ErrorRuntime) -> None:
    """Draw one scene: filled markers for the score, hollow ones for the map."""
    styles = {MONTE_CARLO: ("o", "C0"), FIRST_ORDER: ("s", "C1"), LOOPS: ("D", "C2"), TORCH: ("^", "C3")}
    for error in ERRORS:
        for estimator, (marker, color) in styles.items():
            measured = [m for m in result.measurements if m.estimator == estimator and m.rms(error) > 0]
            if not measured:
                continue
            centers = [m.rms(error) for m in measured]
            axes.errorbar(
                [statistics.median(m.seconds) for m in measured],
                centers,
                yerr=[
                    [center - min(m.errors(error)) for center, m in zip(centers, measured, strict=True)],
                    [max(m.errors(error)) - center for center, m in zip(centers, measured, strict=True)],
                ],
                label=f"{estimator}, {error}",
                marker=marker,
                markerfacecolor=color if error == "score" else "white",
                color=color,
                linestyle="-" if error == "score" else "--",
                markersize=5,
                linewidth=1,
                capsize=2,
            )
    axes.axvline(statistics.median(result.of(DOUBLE).seconds), color="C2", linestyle=":", label=f"{DOUBLE} (reference)")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.set_xlabel("wall-clock time, s")
    render = statistics.median(result.render_seconds)
    top = axes.secondary_xaxis("top", functions=(lambda s: s / render, lambda n: n * render))
    top.set_xlabel("wall-clock time, plain renders")
    ends = [m for m in result.measurements if m.samples is not None]
    for m in (ends[0], ends[-1]):
        place = (statistics.median(m.seconds), m.rms("map"))
        axes.annotate(f"K = {m.samples}", place, (0, 9), textcoords="offset points", ha="center", fontsize="small")


def _conclusion(result: ErrorRuntime, error: Error) -> str:
    """Say how the Monte Carlo error falls, and when it would be that of the exact estimate."""
    needed = result.samples_to_match(error)
    single = result.single.estimator
    text = f"{error}: the error of {MONTE_CARLO} falls as K^{result.slope(error):.2f}"
    if needed is None:
        return f"{text}; {single} has none."
    last = [m for m in result.measurements if m.samples is not None][-1]
    hours = needed / (last.samples or 1) * statistics.median(last.seconds) / 3600
    return f"{text}; continued as K^-0.5 it equals that of {single} at K = {needed:.1e}, after {hours:.1e} hours."


def _settings(model: TrainedModel, view: View, max_samples: int, seeds: int) -> dict[str, object]:
    """Return all that the numbers depend on, the model and the camera as a fingerprint."""
    camera = view.camera
    digest = hashlib.sha256(repr((camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)).encode())
    for tensor in (camera.world_to_camera, model.background, *(x for _, x in model.gaussians.named())):
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return {
        "max_samples": max_samples,
        "seeds": seeds,
        "sh_degree": model.sh_degree,
        "fingerprint": digest.hexdigest(),
        "device": str(model.background.device),
        "engine": describe_engine(model.background.device),
        "exact": list(engines_on(model.background.device)),
        "threads": torch.get_num_threads(),
    }


def _of_run(run: Path, device: str) -> tuple[TrainedModel, View]:
    """Return a run's model and its first test view."""
    model, scene, _ = of_run(run, device)
    return model, (*scene.test, *scene.train)[0].to(device)


def _of_ply(ply: Path, device: str) -> tuple[TrainedModel, View]:
    """Return the model of a PLY over black, and a view from an orbit; it has a camera but no photograph."""
    loaded = load_ply(ply)
    if loaded.opacity_scale != 1 or loaded.for_rendering:
        by = "the mean of their noise" if loaded.for_rendering else f"{loaded.opacity_scale:g}"
        raise ValueError(f"the opacities of {ply} are scaled by {by} for viewers: give the PLY with plain ones.")
    gaussians = loaded.gaussians.to(device)
    camera = orbit_views(gaussians.means, gaussians.opacities, count=1, width=PICTURE, height=PICTURE)[0]
    nothing = torch.zeros(3, device=device)
    return TrainedModel(gaussians, nothing), View("orbit", camera, nothing[:, None, None].expand(3, PICTURE, PICTURE))
