"""What every item of the plan is worth: the same short training with the item on and off, over several seeds.

``python -m benchmarks.plan --path SCENE``.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from benchmarks.calls import processor_clock
from benchmarks.memory import PROCESS, process_status
from reference_trainer.cli import log_shown
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.tables import format_mean_std, markdown_table
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render import render
from reference_trainer.runs.executors import Processes
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.study import Study, in_turns, run_study
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.plan import Plan, make_plan
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

__all__ = ["ALTERNATIVES", "parts_of_a_step", "plan", "plan_study", "plan_table", "shortened", "variants"]

_DROP_RATE = 0.2


def parts_of_a_step(trainer: Trainer, *, repeats: int = 7) -> dict[str, float]:
    """Time render, loss and gradients at the first training view, and how much more or less certain changes take.

    Args:
        trainer: with the model to measure; it does not change.
        repeats: rounds, in turns, of which the fastest counts.

    Returns:
        Seconds, of processors on a CPU: of the "step" (render, loss, gradients), and by how much each change differs.
    """
    gaussians, view, background = trainer.gaussians, trainer.views[0], trainer.background
    leaves = [x for _, x in gaussians.named() if x.numel()]
    generator = stream(trainer.config.seed, 0, "dropout", trainer.device)
    kept = torch.rand(len(gaussians), generator=generator, device=trainer.device) >= _DROP_RATE
    score, model = model_of(trainer).exact_ca_score(), model_of(trainer)

    def step(*, degree: int | None = None, depth: bool = False, opacities: Tensor | None = None) -> None:
        out = render_gaussians(gaussians, view.camera, background, opacities=opacities, sh_degree=degree, depth=depth)
        loss = photometric_loss(out.image, view.image)
        torch.autograd.grad(loss if out.depth is None else loss + 0 * out.depth.mean(), leaves, allow_unused=True)

    def without_background() -> None:
        g = gaussians
        out = render(g.means, g.quaternions, g.scales, g.opacities, view.camera, sh=g.sh)
        loss = photometric_loss(out.image, view.image)
        torch.autograd.grad(loss, leaves, allow_unused=True)

    calls: dict[str, Callable[[], object]] = {
        "step": step,
        "all bands left out": lambda: step(degree=0),
        "background left out": without_background,
        "depth added": lambda: step(depth=True),
        f"{_DROP_RATE:.0%} of the Gaussians dropped": lambda: step(opacities=gaussians.opacities * kept),
    }
    calls["exact moments added"] = lambda: score(model.gaussians.opacities, view)
    seconds = in_turns(calls, repeats, processor_clock(trainer.device))
    fastest = {name: min(times) for name, times in seconds.items()}
    fastest["exact moments added"] += fastest["step"]
    return {name: seconds - fastest["step"] * (name != "step") for name, seconds in fastest.items()}


AS_ASKED = "as asked"
WHOLE_PLAN = "the whole plan"

ALTERNATIVES: dict[str, dict[str, Any]] = {
    "SH degree 0": {"sh_degree": 0},
    "SH degree 1": {"sh_degree": 1},
    "initial size 1/2": {"initial_scale": 0.5},
    "initial size 1/4": {"initial_scale": 0.25},
    "no densification": {"densify_every": 0},
    "no opacity reset": {"opacity_reset_every": 0},
}
"""What a plan could change, whether or not it does."""


Scene = Annotated[SceneOptions, tyro.conf.arg(name="")]
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]


def plan(
    scene: Scene = SceneOptions(),  # noqa: B008
    config: Config = TrainConfig(),  # noqa: B008
    out: Path = Path("runs/plan"),
    steps: int = 1_000,
    seeds: int = 3,
    alternatives: tuple[str, ...] = (),
    device: str = "cpu",
) -> None:
    """Train a scene shortly with every item of its plan on and off; time, memory, quality.

    Args:
        scene: what to train.
        config: what is asked for, in the length that the plan is made for.
        out: folder for the JSON and the table; what is in it is not trained again.
        steps: of each training; the schedule of --iterations is shortened alike.
        seeds: number of seeds.
        alternatives: changes to try besides those of the plan: "SH degree 0", "SH degree 1", "initial size 1/2",
            "initial size 1/4", "no densification", "no opacity reset".
        device: "cpu" or "cuda".
    """
    study = plan_study(scene, config=config, iterations=steps, seeds=seeds, alternatives=alternatives, device=device)
    # Every training has a fresh process, one after the other, because time and peak memory are measured.
    with log_shown():
        run_study(study, out, executor=Processes(1))


def shortened(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return the settings with fewer steps, their schedule of bands, densification and resets moved forward alike.

    Example:
        >>> shortened(TrainConfig(), 1000).opacity_reset_from
        667
    """
    factor = iterations / config.iterations
    return dataclasses.replace(
        config,
        iterations=iterations,
        sh_every=max(1, round(config.sh_every * factor)),
        densify_from=round(config.densify_from * factor),
        prune_size_from=round(config.prune_size_from * factor),
        opacity_reset_from=round(config.opacity_reset_from * factor),
    )


def variants(plan: Plan, config: TrainConfig, alternatives: Sequence[str] = ()) -> dict[str, TrainConfig]:
    """Return the settings to compare: as asked, each item of the plan alone, all of them, and alternatives.

    Args:
        plan: of a scene.
        config: what was asked for.
        alternatives: keys of `ALTERNATIVES`.

    Raises:
        ValueError: if there is no such alternative.

    Example:
        >>> list(variants(Plan(()), TrainConfig(), ["no densification"]))
        ['as asked', 'no densification']
    """
    unknown = sorted(set(alternatives) - set(ALTERNATIVES))
    if unknown:
        raise ValueError(f"there are no alternatives {unknown}; choose of {', '.join(ALTERNATIVES)}.")
    changing = [item for item in plan.items if item.changes]
    chosen = {AS_ASKED: config} | {item.name: Plan((item,)).applied(config) for item in changing}
    if len(changing) > 1:
        chosen[WHOLE_PLAN] = plan.applied(config)
    found = {name: dataclasses.replace(config, **ALTERNATIVES[name]) for name in alternatives}
    return chosen | {name: of for name, of in found.items() if of not in chosen.values()}


def plan_study(
    options: SceneOptions,
    *,
    config: TrainConfig,
    iterations: int = 1_000,
    seeds: int = 3,
    alternatives: Sequence[str] = (),
    device: str = "cpu",
) -> Study:
    """Declare the study: a scene is trained with every item of its plan on and off.

    Args:
        options: the scene.
        config: what is asked for, in the length that the plan is made for.
        iterations: steps of each training; the schedule is shortened alike.
        seeds: number of seeds.
        alternatives: keys of `ALTERNATIVES` to try besides.
        device: where to train.
    """
    plan = make_plan(load_scene(options, seed=config.seed), config)
    chosen = {name: shortened(of, iterations) for name, of in variants(plan, config, alternatives).items()}
    shared = {"options": options, "device": device, "threads": torch.get_num_threads()}
    cases = {
        f"{name}, seed {seed}": {"variant": name, "config": dataclasses.replace(of, seed=seed), **shared}
        for seed in range(seeds)
        for name, of in chosen.items()
    }
    return Study("plan_study", _train, cases, lambda records: plan_table([*records.values()]))


def plan_table(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of the study: per variant mean and deviation over the seeds, differences within a seed.

    Args:
        records: of the trainings.
    """
    base = {record["config"]["seed"]: record for record in records if record["variant"] == AS_ASKED}
    columns = {
        "test PSNR": ("psnr", 1.0),
        "test SSIM": ("ssim", 1.0),
        "test CA x1e-3": ("ca", 1e-3),
        "Gaussians": ("gaussians", 1.0),
        "processor seconds": ("cpu_seconds", 1.0),
        "peak memory, MiB": ("peak_bytes", 2.0**20),
    }
    rows: list[dict[str, object]] = []
    for name in dict.fromkeys(record["variant"] for record in records):
        of = [record for record in records if record["variant"] == name]
        pairs = [(record, base.get(record["config"]["seed"])) for record in of]
        gains = [x["psnr"] - y["psnr"] if y else math.nan for x, y in pairs]
        known = ["n/a" if math.isnan(gain) else f"{gain:+.2f}" for gain in gains]
        difference = "" if name == AS_ASKED else ", ".join(known)
        measured = {
            column: format_mean_std([record[key] for record in of], unit=unit)
            for column, (key, unit) in columns.items()
        }
        rows.append({"variant": name, "seeds": len(of), "PSNR, difference in each seed": difference, **measured})
    table = markdown_table(rows, list(rows[0]))
    parts = next((record["parts"] for record in base.values() if record.get("parts")), None)
    if parts is None:
        return table
    step = parts["step"]
    left = [{"part": name, "ms": 1e3 * s, "% of a step": 100 * s / step} for name, s in parts.items()]
    return table + "\n" + markdown_table(left, ["part", "ms", "% of a step"])


def _train(options: SceneOptions, variant: str, config: TrainConfig, device: str, threads: int) -> dict[str, Any]:
    """Do one training in a process of its own."""
    torch.set_num_threads(threads)
    scene = load_scene(options, seed=config.seed)
    trainer = Trainer(scene, config, device)
    start = time.process_time()
    trainer.train()
    seconds, peak = time.process_time() - start, _peak_bytes()
    split = "test" if scene.test else "train"
    found = evaluate(model_of(trainer), {split: getattr(scene, split)})
    return {
        "variant": variant,
        "config": dataclasses.asdict(config),
        "cpu_seconds": seconds,
        "seconds": trainer.seconds,
        "peak_bytes": peak,
        "gaussians": len(trainer.gaussians),
        **{name: found.mean(split, name) for name in ("psnr", "ssim", "ca", "ca_exact")},
        "parts": parts_of_a_step(trainer) if variant == AS_ASKED and config.seed == 0 else None,
    }


def _peak_bytes() -> int:
    """Return the largest memory that this process has held so far, libraries included; bytes."""
    if PROCESS.exists():  # Linux, where getrusage counts the peak of the parent, too
        return process_status("VmHWM")
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10  # bytes on macOS, KiB elsewhere


if __name__ == "__main__":
    from benchmarks import plan as module  # under its own name, by which the processes of the trainings find it

    tyro.cli(module.plan)
