"""Rules of the guard on finished trainings, under the protocol of benchmarks/guard.md.

    python -m benchmarks.guard measure RUN... --out rules.json    # folders of runs; what is measured is kept
    python -m benchmarks.guard table rules.json
    python -m benchmarks.guard places RUN...                      # each place judged by itself

A row is a model under a rule: PSNR at the test views, at the training views and at held-out views of training kind,
which alone choose, and their pixels that two training photographs share; how many Gaussians went, and the exact score
where nobody was, before and after.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from benchmarks.remedy import held_out
from ca_reg.attribution import hanging
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.metrics import view_psnr
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import blend_weights, unseen_shares
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.runs.folder import read_run_settings
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View, Viewpoint
from reference_trainer.scenes.virtual_cameras import amid_views, unseen_views

__all__ = ["RULES", "by_place", "held_out_views", "keeps", "main", "shared", "unexplained"]

RULES: dict[str, dict[str, Any]] = {
    "ratio 2, 0.3 %": {"ratio": 2.0, "alone": 0.003},
    "ratio 2, 1 %": {"ratio": 2.0, "alone": 0.01},
    "ratio 2, 3 %": {"ratio": 2.0, "alone": 0.03},
    "ratio 4, 0.3 %": {"ratio": 4.0, "alone": 0.003},
    "ratio 4, 1 %": {"ratio": 4.0, "alone": 0.01},
    "ratio 4, 3 %": {"ratio": 4.0, "alone": 0.03},
    "ratio 2, 1 %, fewer cameras": {"ratio": 2.0, "alone": 0.01, "fewer": True},
    "ratio 8, 0.3 %, together 5 %": {"ratio": 8.0, "alone": 0.003, "together": 0.05},
    "ratio 16, 0.3 %, together 5 %": {"ratio": 16.0, "alone": 0.003, "together": 0.05},
    "pilot: 15 twice": {"ratio": 2.0, "alone": 0.0, "most": 15, "rounds": 2},
    "by shares": {"ratio": 64.0, "alone": 0.003, "together": 0.2, "by_shares": True},
    "by shares, unneeded": {"ratio": 64.0, "alone": 0.003, "together": 0.2, "by_shares": True, "spared": 0.3},
    "worth 3": {"ratio": 16.0, "alone": 0.003, "together": 0.05, "worth": 3.0},
    "worth 5": {"ratio": 16.0, "alone": 0.003, "together": 0.05, "worth": 5.0},
    "worth 10": {"ratio": 16.0, "alone": 0.003, "together": 0.05, "worth": 10.0},
}
"""The rules of the protocols, and those that were chosen."""

OTHER_EXPOSURE = {"sceaux": ("7107.jpg",)}
"""Held-out photographs that are no measure."""

_SPLITS = ("held-out", "test", "train")


def main(
    what: Annotated[Literal["measure", "table", "places"], tyro.conf.Positional],
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/guard.json"),
    rules: tuple[str, ...] = tuple(RULES),
) -> None:
    """Measure runs under every rule, or print tables of what was measured.

    Args:
        what: "measure"; "table"; or "places", for what judging each place by itself changes.
        paths: folders of runs, or files of rows.
        out: the file of rows, which is continued.
        rules: those to measure.
    """
    torch.set_num_threads(1)
    if what == "table":
        print("\n\n".join(table(json.loads(path.read_text("utf-8"))) for path in paths))
        return
    if what == "places":
        for run in paths:
            print(run.name, by_place(run), sep=": ", flush=True)
        return
    rows = json.loads(out.read_text("utf-8")) if out.exists() else []
    for run in paths:
        missing = [name for name in ("none", *rules) if (run.name, name) not in {(r["run"], r["rule"]) for r in rows}]
        if missing:
            rows += measure(run, missing)
            write_json(out, rows)
    print(table(rows))


def measure(run: Path, rules: Sequence[str]) -> list[dict[str, Any]]:
    """Return the rows of a run, "none" being the model as it is."""
    model, scene = load_run_model(run)
    options, config = read_run_settings(run / "config.json")
    others = held_out_views(options, config.seed)
    splits: dict[str, Sequence[View]] = dict(zip(_SPLITS, (others, scene.test, scene.train), strict=True))
    splits["shared"] = shared(model, scene, others)
    known: dict[bytes, tuple[Tensor, Tensor, Tensor, Tensor, float]] = {}
    rows, of_kept = [], dict[bytes, dict[str, dict[str, float]]]()
    for name in rules:
        start = time.process_time()
        keep, scores, where = keeps(model, scene, known, **RULES.get(name, {"rounds": 0}))
        found = of_kept.get(bytes(keep.tolist()))
        if found is None:
            rest = replace(model, gaussians=model.gaussians[keep])
            found = {split: {v.name: quality(rest, v) for v in views} for split, views in splits.items()}
            of_kept[bytes(keep.tolist())] = found
        rows.append(
            {"run": run.name, "rule": name, "gaussians": len(keep), "removed": int((~keep).sum()), "scores": scores,
             "where": where, "seconds": time.process_time() - start}
            | {split: sum(of.values()) / max(1, len(of)) for split, of in found.items()} | {"views": found}
        )  # fmt: skip
        shown = {split: round(rows[-1][split], 2) for split in splits}
        print(run.name, name, rows[-1]["removed"], shown, *(f"{1e3 * x:.2f}" for x in scores), flush=True)
    return rows


def held_out_views(options: SceneOptions, seed: int) -> list[View]:
    """Return the held-out views of a scene, without those of another exposure."""
    others = OTHER_EXPOSURE.get(Path(options.path).name, ())
    return [view for view in held_out(options, seed).test if view.name not in others]


def shared(model: TrainedModel, scene: Scene, views: Sequence[View]) -> list[View]:
    """Return views whose masks leave the pixels that training photographs share, without views that have none.

    These are the pixels whose surface, by the depth of the model, at least two training photographs show.
    """
    maps, found = ErrorMaps(model, scene.train), list[View]()
    for view in views:
        seen = (maps.support(view) >= 2).to(view.image)
        mask = seen if view.mask is None else seen * view.mask
        found += [replace(view, mask=mask)] if mask.any() else []
    return found


@torch.no_grad()
def quality(model: TrainedModel, view: View) -> float:
    """Return the PSNR of a view."""
    return view_psnr(model.test_rendering(view).image, view)


@torch.no_grad()
def unexplained(model: TrainedModel, views: Sequence[View], shares: Tensor, worth: float) -> Tensor:
    """Return which Gaussians risk more where nobody took a photograph than they explain of those taken, (N,), bool.

    A Gaussian risks its share of the score, (N,), and explains by how much the mean squared error of the photographs
    rises without it: both are squares of colors. Found are those with a hundredth of the score or more whose share is
    more than ``worth`` times what they explain.
    """

    def error(of: TrainedModel) -> float:
        return fmean((of.test_rendering(v).image.clamp(0, 1) - v.image).square().mean().item() for v in views)

    found, whole = torch.zeros_like(shares, dtype=torch.bool), error(model)
    for i in ((shares > 0) & (shares >= 0.01 * shares.sum())).nonzero()[:, 0].tolist():
        rest = torch.ones_like(found)
        rest[i] = False
        rise = error(replace(model, gaussians=model.gaussians[rest])) - whole
        found[i] = shares[i].item() > worth * max(rise, 0.0)
    return found


@torch.no_grad()
def keeps(
    model: TrainedModel,
    scene: Scene,
    known: dict[bytes, tuple[Tensor, Tensor, Tensor, Tensor, float]],
    *,
    ratio: float = 2.0,
    alone: float = 0.0,
    together: float = 0.0,
    most: int | None = None,
    rounds: int = 3,
    fewer: bool = False,
    by_shares: bool = False,
    spared: float | None = None,
    worth: float | None = None,
) -> tuple[Tensor, list[float], dict[str, int]]:
    """Return what a rule keeps, the score after each round, and where what went had its highest share.

    As `reference_trainer.evaluation.shares.guard`, with the alternatives of the protocol; ``known`` keeps what rules
    with equal beginnings share. ``spared`` is what the training photographs may lose in the mean, dB; ``worth`` adds
    those that are `unexplained`.
    """
    views: list[Viewpoint] = unseen_views(scene)
    if fewer:  # of 1/4, 1/2, 3/4 between the middle one, of 1/3, 2/3 and 1 beyond the last two
        views = [v for i, v in enumerate(views) if (i % 3 == 1 if v.name.startswith("between") else i % 3 > 0)]
    keep, scores, where = torch.ones(len(model.gaussians), dtype=torch.bool), list[float](), Counter[str]()
    for number in range(rounds + 1):
        key = bytes(keep.tolist()) + bytes([fewer, by_shares])
        if key not in known:
            rest = replace(model, gaussians=model.gaussians[keep])
            shares, where_highest, score = unseen_shares(rest, views)
            if by_shares:
                there, here = shares, unseen_shares(rest, scene.train)[0]
            else:
                there, here = (blend_weights(rest.without_camera, of) / len(of) for of in (views, scene.train))
            known[key] = shares, where_highest, there, here, score
        shares, where_highest, there, here, score = known[key]
        scores.append(score)
        hang = hanging(shares, there, here, ratio=ratio, together=together, alone=alone)
        if worth is not None:
            hang |= unexplained(replace(model, gaussians=model.gaussians[keep]), scene.train, shares, worth)
        if most is not None:
            held = torch.where(hang, shares, 0.0)
            hang &= held >= held.sort(descending=True).values[min(most, len(held)) - 1]
        if number == rounds or not bool(hang.any()):
            break
        left = keep.clone()
        left[keep] = ~hang
        if spared is not None:
            before, after = (
                fmean(quality(of, view) for view in scene.train)
                for of in (model, replace(model, gaussians=model.gaussians[left]))
            )
            if before - after > spared:
                break
        where.update(views[i].name for i in where_highest[hang].tolist())
        keep = left
    return keep, scores, dict(where)


@torch.no_grad()
def by_place(run: Path, rounds: int = 3) -> str:
    """Return what changes if each place is judged by itself, amid 3 and 4 neighbors or, of few cameras, on their ways.

    PSNR at held-out / test views, dB, and how many Gaussians go in each round.
    """
    model, scene = load_run_model(run)
    options, config = read_run_settings(run / "config.json")
    others = held_out_views(options, config.seed)

    def figures(keep: Tensor) -> Tensor:
        rest = replace(model, gaussians=model.gaussians[keep])
        return torch.tensor([fmean(quality(rest, view) for view in of) for of in (others, scene.test)])

    before = figures(torch.ones(len(model.gaussians), dtype=torch.bool))
    found = ["{:.2f} / {:.2f}".format(*before.tolist())]
    for places in (
        [amid_views(scene, neighbors) for neighbors in (3, 4)] if amid_views(scene) else [unseen_views(scene)]
    ):
        start, keep, removed = time.process_time(), torch.ones(len(model.gaussians), dtype=torch.bool), list[int]()
        while len(removed) < rounds and (not removed or removed[-1]):
            rest = replace(model, gaussians=model.gaussians[keep])
            here = blend_weights(rest.without_camera, scene.train) / 3  # as if three photographs had been taken
            hang = torch.zeros(len(rest.gaussians), dtype=torch.bool)
            for place in places:
                hang |= hanging(unseen_shares(rest, [place])[0], blend_weights(rest.without_camera, [place]), here)
            removed.append(int(hang.sum()))
            keep[keep.clone()] = ~hang
        took = time.process_time() - start
        found.append("{:+.2f} / {:+.2f}".format(*(figures(keep) - before).tolist()) + f" {removed} {took:.0f} s")
    return ", ".join(found)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table: what every rule changes on every run, against the model as it is."""
    runs, rules = dict.fromkeys(r["run"] for r in rows), dict.fromkeys(r["rule"] for r in rows if r["rule"] != "none")
    of = {(r["run"], r["rule"]): r for r in rows}
    lines = []
    splits = [split for split in (*_SPLITS[:2], "shared") if any(split in row for row in rows)]
    for run in runs:
        plain = of[run, "none"]
        line = {"model": run, "score": f"{1e3 * plain['scores'][0]:.2f}"}
        line |= {f"{split} PSNR": f"{plain[split]:.2f}" for split in splits}
        for rule in rules:
            if row := of.get((run, rule)):
                changes = "/".join(f"{row[split] - plain[split]:+.2f}" for split in splits)
                line[rule] = f"{changes} ({row['removed']})"
        lines.append(line)
    titles = ["model", "score", *(f"{split} PSNR" for split in splits), *rules]
    return markdown_table([dict.fromkeys(titles, "-") | line for line in lines], titles)


if __name__ == "__main__":
    tyro.cli(main)
