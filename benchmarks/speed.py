"""Time, memory and error of the engines on the standard workloads, and of a training step.

On a CPU everything but the comparison of threads is time of processors, which other programs disturb little: ratios of
one thread are the most exact, ``OMP_NUM_THREADS=1 python -m benchmarks.speed``.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from benchmarks.calls import BASELINE, PASSES, Render, gradients, image, others_on, processor_clock, render_with
from benchmarks.memory import peak_memory
from benchmarks.speed_report import regressions, speed_tables
from benchmarks.stages import STAGES, Staged, staged
from benchmarks.training_step import MASKS, PARTS, analytic_step, scores, step_parts
from benchmarks.workloads import WORKLOADS, Workload, WorkloadSpec, covered_pairs
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.render.engine import engines_on
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.studies.study import in_turns, now

__all__ = ["measure_speed", "speed"]

REPORT, TABLE = "speed.json", "speed.md"
_GRADIENTS_UP_TO = 2_000  # Gaussians: the reference keeps every pair in float64

Seconds = Mapping[str, Sequence[float]]


def speed(
    out: Path = Path("runs/speed"),
    workloads: tuple[Literal["small", "medium", "large"], ...] = ("small", "medium"),
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = SceneOptions(),  # noqa: B008
    repeats: int = 7,
    against: Path | None = None,
    device: str = "cpu",
) -> None:
    """Measure the speed of the engines, and write speed.json and speed.md.

    Args:
        out: folder for the results.
        workloads: "large" takes minutes, nearly all of them in the baseline, whose gradient keeps about 2.5 GB.
        scene: of the training step.
        repeats: rounds of which the medians are taken.
        against: an older speed.json; slower or less exact than that is an error.
        device: where to render, "cpu" or "cuda".
    """
    specs: dict[str, WorkloadSpec] = {name: WORKLOADS[name] for name in workloads}
    measure_speed(specs, out, scene=load_scene(scene), repeats=repeats, against=against, device=device)


def measure_speed(
    specs: Mapping[str, WorkloadSpec],
    out: Path,
    *,
    scene: Scene,
    repeats: int = 7,
    against: Path | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Measure workloads of any size; see `speed`.

    Returns:
        The content of ``speed.json``. Its "ratios" and "errors" are what later measurements are compared by.

    Raises:
        FileNotFoundError, KeyError: if ``against`` is missing or another file.
        ValueError: as `regressions`.
        RuntimeError: if a ratio of times or an error has grown by more than `regressions` allows; lists them, after
            everything is written.
    """
    old = (
        None if against is None else {key: read_json(against)[key] for key in ("device", "machine", "ratios", "errors")}
    )
    place = torch.device(device)
    results = {}
    for name, spec in specs.items():
        print(f"{name}: {spec.gaussians} Gaussians, {spec.width}x{spec.height}")
        results[name] = _workload(spec, repeats, place)
    print(f"training steps of {scene.name}")
    training = _training(scene, repeats, place)
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": place.type,
        "machine": machine(),
        "repeats": repeats,
        "workloads": results,
        "training": training,
        "ratios": {
            f"{name}, {key}": x for name, w in (*results.items(), ("step", training)) for key, x in w["ratios"].items()
        },
        "errors": {f"{name}, {key}": x for name, w in results.items() for key, x in w["errors"].items()},
    }
    write_json(out / REPORT, report)
    write_text(out / TABLE, speed_tables(report))
    print(speed_tables(report))
    if old is not None and (lines := regressions(report, old)):
        raise RuntimeError(f"{len(lines)} numbers are worse than in {against}:\n" + "\n".join(f"  {x}" for x in lines))
    return report


def _workload(spec: WorkloadSpec, repeats: int, device: torch.device) -> dict[str, Any]:
    """Measure everything that renders a workload, in turns."""
    workload, clock, engines = spec.make().to(device), processor_clock(device), engines_on(device)
    renders = {**others_on(device), "baseline": BASELINE}
    runs: dict[str, list[Staged]] = {engine: [] for engine in engines}

    def in_stages(engine: str) -> None:
        runs[engine].append(staged(workload, engine, clock))

    calls: dict[str, Callable[[], object]] = {}
    for name, render_fn in renders.items():
        calls |= {
            f"{name}: {x}": partial(call, render_fn, workload)
            for x, call in zip(PASSES, (image, gradients), strict=True)
        }
    for engine in engines:
        calls[f"{engine}: stages"] = partial(in_stages, engine)
        calls |= {f"{engine}: {what}": call for what, call in scores(workload, engine).items()}
    seconds = in_turns(calls, repeats, clock)
    pairs = {f"{name}: {x} / baseline": (f"{name}: {x}", f"baseline: {x}") for name in renders for x in PASSES}
    what = ("exact score", f"score, K = {MASKS}")
    pairs |= {f"{e}: {x} / render": (f"{e}: {x}", f"{e}: render") for e in engines for x in what}
    ratios = {name: _ratio(seconds, a, b) for name, (a, b) in pairs.items() if a != b}
    if device.type == "cpu":
        ratios |= {f"{e}: two threads / one": _two_threads(render_with(e), workload, repeats) for e in engines}
    return {
        "gaussians": spec.gaussians,
        "width": spec.width,
        "height": spec.height,
        "pairs": covered_pairs(workload),
        "seconds": seconds,
        "stages": {e: {x: [run.seconds[x] for run in runs[e][-repeats:]] for x in STAGES} for e in engines},
        "entries": {e: runs[e][0].entries for e in engines},
        "memory": {e: peak_memory(spec, e, device) for e in engines},
        "ratios": ratios,
        "errors": {f"{e}: {x}": y for e in engines for x, y in _errors(render_with(e), workload).items()},
    }


def _two_threads(render_fn: Render, workload: Workload, repeats: int) -> float:
    """Return the wall-clock time of a gradient with two threads over that with one."""
    before = torch.get_num_threads()

    def with_threads(count: int) -> None:
        torch.set_num_threads(count)
        gradients(render_fn, workload)

    try:
        calls = {str(count): partial(with_threads, count) for count in (1, 2)}
        return _ratio(in_turns(calls, repeats, partial(now, workload.means.device)), "2", "1")
    finally:
        torch.set_num_threads(before)


def _errors(render_fn: Render, workload: Workload) -> dict[str, float]:
    """Return errors against float64: absolute of the image, of gradients the norm of the error over the norm."""
    precise = workload.to(dtype=torch.float64)
    difference = (image(render_fn, workload).double() - image(BASELINE, precise)).abs()
    errors = {"image, mean": difference.mean().item(), "image, max": difference.max().item()}
    if len(workload.means) <= _GRADIENTS_UP_TO:
        found, true = gradients(render_fn, workload), gradients(BASELINE, precise)
        errors |= {f"gradient of {name}": _relative(found[name], true[name]) for name in true}
    return errors


def _relative(found: Tensor, true: Tensor) -> float:
    return float((found.double() - true).norm() / true.norm())


def _training(scene: Scene, repeats: int, device: torch.device) -> dict[str, Any]:
    """Measure training steps, rendered by each engine."""
    clock, engines = processor_clock(device), engines_on(device)
    parts = {e: step_parts(scene, e, repeats=repeats, device=device, clock=clock) for e in engines}
    steps = {e: analytic_step(scene, e, repeats=repeats, device=device, clock=clock) for e in engines}
    camera = scene.train[0].camera
    ratios = {f"{e}: analytic / sampled": _ratio(steps[e], "analytic", "sampled") for e in engines}
    ratios |= {
        f"{e}: {part} / step": _ratio(parts[e], part, "step") for e in engines for part in PARTS if part != "rest"
    }
    return {
        "scene": f"{scene.name}, {camera.width}x{camera.height}",
        "parts": parts,
        "steps": steps,
        "ratios": ratios,
    }


def _ratio(seconds: Seconds, a: str, b: str) -> float:
    """Return the median of the quotients per round."""
    return statistics.median(x / y for x, y in zip(seconds[a], seconds[b], strict=True))


if __name__ == "__main__":
    tyro.cli(speed)
