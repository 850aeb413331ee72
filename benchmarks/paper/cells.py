"""The grid of trainings that the claims need: which they are, what is missing, and running and measuring it."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.paper.claims import Claim, Setting
from benchmarks.paper.comparison import FEW_SEEDS, RowStore, undecided
from benchmarks.paper.rows import Row, Rows, config_of, label, resolved, value
from benchmarks.paper.scenes import PaperScene
from ca_reg.monitor import LOG_NAME
from reference_trainer.evaluation.metrics import depth_errors, psnr
from reference_trainer.evaluation.tables import mean_std
from reference_trainer.evaluation.trained_model import MaskedRenders, TrainedModel
from reference_trainer.runs.executors import Failure, Task, attempt
from reference_trainer.runs.folder import folder_name
from reference_trainer.runs.grid import Run, Running, run_grid
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.threads import threads_for

__all__ = ["Cell", "Grid", "declared", "estimate", "is_done", "listing", "rows_of", "run_cells"]

EXTRAS = frozenset({"path", "renders", "depth"})
"""What a training can be measured for beyond the usual."""
SIXTHS = 6
COURSE = ("ca/train", "psnr/test", "psnr/train")
"""What is kept at every sixth of the steps beside the CA of test views, under the names of the log."""
OPAQUE = 0.8
DENSER = 2
"""Factor on the iterations for the model of all photographs, whose depth serves as the truth."""
_FIGURES = ("psnr", "ssim", "lpips", "ca", "ca_half", "ca_exact", "ca_exact_half", "cv",
            "depth_abs_rel", "depth_rmse")  # fmt: skip
_STEP = 0.07
"""Assumed processor seconds per step of a training without kept ones like it."""


@dataclass(frozen=True)
class Grid:
    """The requested trainings.

    Args:
        claims: by name.
        scenes: by name, with the paths of their folders.
        recipe: of all trainings that do not name another.
        iterations: of every training.
        seeds: number of seeds.
        out: folder for the trainings, ``NAME/LABEL/seed_K``, each removed once its row is kept.
        rows: folder of the kept rows, ``NAME.json``.
        sequential: whether seeds beyond `FEW_SEEDS` are only for what these leave undecided.

    Raises:
        ValueError: if there is no seed.
    """

    claims: Mapping[str, Claim]
    scenes: Mapping[str, PaperScene]
    recipe: str = "3dgs"
    iterations: int = 3_000
    seeds: int = 3
    out: Path = Path("runs/paper")
    rows: Path = Path("runs/paper")
    sequential: bool = False

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"expected at least 1 seed, got {self.seeds}.")


@dataclass(frozen=True)
class Cell:
    """One training, and what is measured beyond the usual."""

    scene: str
    setting: Setting
    seed: int
    needs: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"{self.scene}, {label(self.setting, {'iterations': self.setting['iterations']})}, seed {self.seed}"


def declared(grid: Grid) -> list[Cell]:
    """Return the trainings of a grid, each once, ordered by seed, then by claim."""
    found: dict[str, Cell] = {}
    few = RowStore(grid.rows, grid.recipe, grid.iterations, FEW_SEEDS) if grid.sequential else None
    for seed in range(grid.seeds):
        for claim in grid.claims.values():
            for name in (each for each in grid.scenes if each in claim.scenes):
                for given in claim.settings if few is None or seed < FEW_SEEDS else undecided(claim, name, few):
                    cell = Cell(name, resolved(given, grid.recipe, grid.iterations), seed, claim.needs)
                    known = found.get(cell.name, cell)
                    found[cell.name] = replace(cell, needs=cell.needs | known.needs)
    return list(found.values())


def run_cells(grid: Grid, running: Running) -> dict[str, Failure]:
    """Run what is missing of a grid; every finished training is measured and kept before another one starts.

    A training of which something else is kept is made again, and measured for that as well: nothing is lost.

    Args:
        grid: what to run.
        running: where and how; what is monitored is what the trainings are measured for.

    Returns:
        Failures by the name of the training. The same call tries them again.

    Raises:
        ValueError: if a scene has no test views.
        FileNotFoundError: if there is no such scene.
    """
    few = replace(grid, seeds=FEW_SEEDS)
    failed = run_cells(few, running) if grid.sequential and grid.seeds > FEW_SEEDS else {}
    rows = rows_of(grid)
    left = [
        replace(cell, needs=cell.needs | EXTRAS & (_row_of(cell, rows) or {}).keys())
        for cell in declared(grid)
        if not is_done(cell, rows)
    ]
    for name in dict.fromkeys(cell.scene for cell in left):
        folder = grid.scenes[name].options.path
        if folder != "synthetic" and not Path(folder).is_dir():
            raise FileNotFoundError(
                f"there is no folder {folder}: say with --data, or $CA_REG_DATA, where the scenes are."
            )
        if not load_scene(grid.scenes[name].options).test:
            raise ValueError(f"{name} has no test views, which the claims are about: hold some out with --split llff.")
    cells = {folder_of(grid, cell): cell for cell in left}

    def keep(run: Run, results: dict[str, Any]) -> None:
        if cell := cells.get(run.out):
            dense = grid.out / cell.scene / "dense"
            task = Task(run.label, measured, (cell, run.out, results, dense, running.device))
            row = attempt(task, torch.get_num_threads())
            if isinstance(row, Failure):
                failed[run.label] = row
            else:
                rows[cell.scene].add(row.value)
                shutil.rmtree(run.out)

    against = dict.fromkeys(cell.scene for cell in left if "depth" in cell.needs)
    denser = config_of(resolved({}, "3dgs", DENSER * grid.iterations), 0)
    photographed = {name: scene for name in against if (scene := grid.scenes[name]).options.path != "synthetic"}
    references = [
        Run(f"{name}, dense", x.dense, denser, grid.out / name / "dense", Monitoring(0))
        for name, x in photographed.items()
    ]
    for runs in (references, [_run(grid, cell) for cell in left]):
        for run, end in zip(runs, run_grid(runs, running, done=keep), strict=True):
            failed.update({run.label: end} if isinstance(end, Failure) else {})
    return failed


def rows_of(grid: Grid) -> dict[str, Rows]:
    """Return the kept rows of every scene."""
    usual = asdict(SceneOptions())

    def about(name: str, scene: PaperScene) -> dict[str, Any]:
        options = {key: x for key, x in asdict(scene.options).items() if key != "path" and x != usual[key]}
        return {"scene": name, "about": scene.about, "options": options}

    return {
        name: Rows(grid.rows / f"{name}.json", about(name, scene), grid.out / f".{name}.lock")
        for name, scene in grid.scenes.items()
    }


def is_done(cell: Cell, rows: Mapping[str, Rows]) -> bool:
    """Return whether everything that is needed from a training is kept."""
    return (row := _row_of(cell, rows)) is not None and cell.needs <= row.keys()


def estimate(cell: Cell, rows: Mapping[str, Rows]) -> float:
    """Estimate the processor seconds of a training from the kept ones of the same scene, recipe and loss."""
    setting = cell.setting
    like = [
        value(row, "seconds") / row["setting"]["iterations"]
        for row in rows[cell.scene].rows
        if all(row["setting"].get(name) == setting.get(name) for name in ("recipe", "loss"))
    ]
    return float(mean_std(like or [_STEP])[0] * setting["iterations"])


def listing(grid: Grid) -> str:
    """Return a line per training, "kept" or its estimated minutes, then the estimated hours per claim and in total."""
    rows, cells = rows_of(grid), declared(grid)
    left = {cell.name: estimate(cell, rows) / 3600 for cell in cells if not is_done(cell, rows)}
    lines = [f"{cell.name}: " + (f"{60 * left[cell.name]:.0f} min" if cell.name in left else "kept") for cell in cells]
    for name, claim in grid.claims.items():
        of = [cell.name for cell in declared(replace(grid, claims={name: claim}))]
        hours = sum(left.get(each, 0.0) for each in of)
        lines.append(f"claim {name}: {len(of)} trainings, {sum(each in left for each in of)} left, {hours:.1f} hours")
    total = f"{len(cells)} trainings, {len(left)} left: about {sum(left.values()):.1f} hours of one core"
    return "\n".join([*lines, f"all: {total}, claims share trainings"])


@torch.no_grad()
def measured(cell: Cell, run: Path, results: Mapping[str, Any], dense: Path, device: str = "cpu") -> Row:
    """Return the row of a finished training."""
    means = {
        split: {name: x for name in _FIGURES if (x := results["mean"].get(split, {}).get(name)) is not None}
        for split in ("test", "train")
    }
    origin = {"commit": commit(), "version": results["machine"]["ca_reg"], "cpu": results["machine"]["cpu"]}
    origin |= {"lpips": metric} if (metric := results.get("perceptual_metric")) else {}
    origin |= {} if device == "cpu" else {"device": results["machine"]["device"]}
    row: Row = {"setting": dict(cell.setting), "seed": cell.seed, **means, "gaussians": results["gaussians"],
                "seconds": results["processor_seconds"]}  # fmt: skip
    if "path" in cell.needs:
        log = [json.loads(line) for line in (run / LOG_NAME).read_text("utf-8").splitlines()][:SIXTHS]
        row["path"], *others = (
            {str(sixth): each[name] for sixth, each in enumerate(log, start=1)} for name in ("ca/test", *COURSE)
        )
        row["course"] = dict(zip(COURSE, others, strict=True))
    if cell.needs & {"renders", "depth"}:
        model, scene = load_run_model(run, device)
        views = [view.to(device) for view in scene.test]
        with threads_for(scene.pixels):
            if "renders" in cell.needs:
                row["renders"] = _mean([renders(model, view, cell.seed) for view in views])
            if "depth" in cell.needs:
                truth = None if views[0].depth is not None else load_run_model(dense, device)[0]
                row["depth"] = _mean([depths(model, view, truth) for view in views])
    return {**_rounded(row), **origin}


def renders(model: TrainedModel, view: View, seed: int, draws: int = 5) -> dict[str, float]:
    """Return the PSNR of a model trained with dropout or noise, by how it is rendered.

    "one" is the mean PSNR of renders under one draw each, "five" the PSNR of the mean of these renders, "mean" that of
    the exact mean, "scaled" that of a render with the mean opacities, which after dropout is the test-time render.
    """
    x = model.params(view.camera)
    generator = torch.Generator(x.opacities.device).manual_seed(seed)
    drawn = torch.stack([model.chain.regularize(x, generator).opacities for _ in range(draws)])
    images = MaskedRenders(model).render_batch(drawn, view)[0]
    factors = model.chain.alpha_factor(x)
    assert factors is not None
    pictures = {"five": images.mean(0), "mean": model.moments(factors[0].opacities, view, factors[1]).mean,
                "scaled": model.render(factors[0].opacities * factors[1].mean, view)[0]}  # fmt: skip
    found = {name: psnr(image.clamp(0, 1), view.image, view.mask) for name, image in pictures.items()}
    return {"one": mean_std(psnr(image.clamp(0, 1), view.image, view.mask) for image in images)[0]} | found


def depths(model: TrainedModel, view: View, truth: TrainedModel | None) -> dict[str, float]:
    """Return the depth errors at a view, against the true depth or that of another model where it is opaque."""

    def depth(of: TrainedModel) -> tuple[Tensor, Tensor]:
        out = of.test_rendering(view, depth=True)
        assert out.depth is not None
        return out.depth / out.alpha.clamp_min(1e-6), out.alpha

    known = view.depth
    if truth is not None:
        far, alpha = depth(truth)
        known = far.where(alpha > OPAQUE, 0.0)
    assert known is not None
    known = known if view.mask is None else known * (view.mask > 0.5)
    return depth_errors(depth(model)[0], known)._asdict()


def _row_of(cell: Cell, rows: Mapping[str, Rows]) -> Row | None:
    """Return the row of a training, if there is one."""
    return rows[cell.scene].of(cell.setting).get(cell.seed)


def folder_of(grid: Grid, cell: Cell) -> Path:
    """Return the folder of a training."""
    hidden = {"iterations": cell.setting["iterations"]}
    return grid.out / cell.scene / folder_name(label(cell.setting, hidden)) / f"seed_{cell.seed}"


def _run(grid: Grid, cell: Cell) -> Run:
    """Return a training as a run of `run_grid`, whose CA is monitored if its course is asked for."""
    config = config_of(cell.setting, cell.seed)
    options = grid.scenes[cell.scene].options_for(cell.setting, config.loss)
    every = max(1, grid.iterations // SIXTHS) if "path" in cell.needs else 0
    return Run(cell.name, options, config, folder_of(grid, cell), Monitoring(every, protocol=True))


def _mean(of: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the means of figures over the views where they are finite."""
    return {name: mean_std(each[name] for each in of)[0] for name in of[0]}


def _rounded(data: Any) -> Any:
    """Round nested figures to six digits; None replaces what is not finite."""
    if isinstance(data, dict):
        return {name: _rounded(x) for name, x in data.items()}
    return (float(f"{data:.6g}") if math.isfinite(data) else None) if isinstance(data, float) else data


def commit() -> str | None:
    """Return the commit of this checkout, with "-dirty" if files differ from it; None outside a checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # an unpacked archive may lie within another project's repository
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
