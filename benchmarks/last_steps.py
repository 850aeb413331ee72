"""The mean of the parameters over the last steps of a training, under the protocol of benchmarks/choices.md.

    python -m benchmarks.last_steps train STARTS SCENE... --seeds 3 --out last_steps.json    # rows are kept
    python -m benchmarks.last_steps table last_steps.json

STARTS is a folder of `benchmarks.start_scenes points`. A row is a training: held-out and test PSNR of its last step,
and of the mean over several numbers of last steps, as it is and with density control that ends earlier.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from benchmarks.guard import held_out_views, quality
from benchmarks.paper.scenes import SCENES
from benchmarks.setting import HELD_OUT
from benchmarks.start_scenes import SIFT
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import guard
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

__all__ = ["Means", "main", "table", "trained"]

Row = dict[str, Any]
"""``scene``, ``seed``, and by candidate the PSNR of held-out views, if there are such, and of test views."""

UNTIL: dict[str, int | None] = {"": None, "until 2,500, ": 2_500}
"""Where density control ends, by the beginning of a candidate's name."""
WINDOWS = {"": (1, 25, 50, 100), "until 2,500, ": (1, 100, 250, 500)}
"""Over how many last steps the mean is taken; 1 is the last step itself."""
SPLITS = "held-out", "test"


class Means:
    """Means of a training's parameters over its last steps, of several numbers of steps.

    The set of Gaussians must not change meanwhile.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> from reference_trainer.training.config import TrainConfig
        >>> trainer = Trainer(synthetic_scene(width=48, height=36, points=200), TrainConfig(iterations=3))
        >>> means = Means(3, (1, 2))
        >>> trainer.train(after_step=means)
        >>> bool((means.of(1).means == trainer.gaussians.means).all())
        True
    """

    def __init__(self, iterations: int, windows: Sequence[int]) -> None:
        self.iterations = iterations
        self._sums: dict[int, dict[str, Tensor]] = {window: {} for window in windows}

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> None:
        """Add the parameters of a step."""
        for window, sums in self._sums.items():
            if trainer.step > self.iterations - window:
                for name, x in trainer.gaussians.named():
                    sums[name] = sums[name] + x if name in sums else x.detach().clone()

    def of(self, window: int) -> Gaussians:
        """Return the mean over so many last steps."""
        return Gaussians.from_named({name: x / window for name, x in self._sums[window].items()})


def main(
    what: Annotated[Literal["train", "table"], tyro.conf.Positional],
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    seeds: tuple[int, ...] = (3,),
    out: Path = Path("runs/last_steps.json"),
) -> None:
    """Train, or print the table.

    Args:
        what: "train" or "table".
        paths: the folder of starts and names of scenes in it, or one file of rows.
        seeds: of the trainings.
        out: the file of rows, which is continued.
    """
    torch.set_num_threads(1)
    if what == "table":
        print(table(json.loads(paths[0].read_text("utf-8"))))
        return
    for seed in seeds:
        for name in map(str, paths[1:]):
            known = json.loads(out.read_text("utf-8")) if out.exists() else []
            if not any((row["scene"], row["seed"]) == (name, seed) for row in known):
                row = trained(_options(paths[0], name), name, seed)
                print(row, flush=True)
                write_json(out, [*known, row])


def _options(starts: Path, name: str) -> SceneOptions:
    """Return a scene with the start that a user has."""
    if name == "synthetic":
        return SCENES[name].options
    cloud = "dense_and_few.ply" if name in SIFT else "dense.ply"
    return replace(SCENES[name].options, path=str(starts / name), points=cloud, allow_test_points=True)


def trained(options: SceneOptions, name: str, seed: int) -> Row:
    """Train once, with both ends of density control, and return the row."""
    scene = load_scene(options, seed=seed)
    views: dict[str, Sequence[View]] = {"test": scene.test}
    if name in HELD_OUT:
        views["held-out"] = held_out_views(options, seed)
    config = with_recipe("sparse", seed=seed, guard=0)  # every mean gets a guard of its own
    first, *forks = (Trainer(scene, replace(config, densify_until=until)) for until in UNTIL.values())
    first.train(until=max(until for until in UNTIL.values() if until))
    for fork in forks:  # to here they are the same
        fork.models[0].load_state_dict(first.models[0].state_dict())
        fork.step = first.step
    row: Row = {"scene": name, "seed": seed, "gaussians": {}}
    for begin, trainer in zip(UNTIL, (first, *forks), strict=True):
        means = Means(config.iterations, WINDOWS[begin])
        trainer.train(after_step=means)
        row["gaussians"][begin] = len(trainer.gaussians)
        for window in WINDOWS[begin]:
            model = _guarded(trainer, means.of(window), scene)
            row[f"{begin}{window}"] = {of: fmean(quality(model, view) for view in views[of]) for of in views}
    return row


def _guarded(trainer: Trainer, gaussians: Gaussians, scene: Scene) -> TrainedModel:
    """Return a model without what hangs where nobody took a photograph, as at the end of a training."""
    model = replace(model_of(trainer), gaussians=gaussians)
    return replace(model, gaussians=gaussians[guard(model, scene).keep])


def table(rows: Sequence[Row]) -> str:
    """Return the gains of all means over the last step of the same training: held-out / test views, mean over seeds.

    The built-in scene has no part in the mean over scenes.
    """
    by_scene: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        by_scene[row["scene"]].append(row)
    lines = []
    for begin, windows in WINDOWS.items():
        for window in windows:
            if (name := f"{begin}{window}") == "1":
                continue
            gains: dict[str, dict[str, float]] = {}
            for scene in (x for x in SCENES if x in by_scene):
                gains[scene] = {
                    of: fmean(row[name][of] - row["1"][of] for row in by_scene[scene])
                    for of in SPLITS
                    if of in by_scene[scene][0]["1"]
                }
            line = {"candidate": f"{begin}mean over {window}" if window > 1 else f"{begin}the last step"}
            line |= {scene: " / ".join(f"{x:+.2f}" for x in of.values()) for scene, of in gains.items()}
            chosen_by = [of for scene, of in gains.items() if scene != "synthetic"]
            means = [[of[split] for of in chosen_by if split in of] for split in SPLITS]
            line["mean"] = " / ".join(f"{fmean(of):+.2f}" for of in means if of)
            if gains:
                lines.append(line)
    return markdown_table(lines, [*lines[0]]) if lines else "Nothing was trained."


if __name__ == "__main__":
    tyro.cli(main)
