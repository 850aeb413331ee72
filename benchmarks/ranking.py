"""The ranking study: how the variants of the CA score order the same models, and why they differ.

``python -m benchmarks.ranking RUN ...``.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier
from ca_reg.types import read_moments
from reference_trainer.cli import log_shown
from reference_trainer.evaluation.metrics import first_order_map, psnr
from reference_trainer.evaluation.style import WIDTH, color, readable
from reference_trainer.evaluation.tables import markdown_table, mean_std
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.runs.folder import CONFIG, read_run_settings
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.studies.study import Record, Records, Study, checkpoints, run_study

__all__ = ["VARIANTS", "correlations", "disagreements", "group_labels", "mean_of", "ranking_study", "score_view"]

VARIANTS = {
    "protocol": "the paper's protocol: 5 renders at drop rate 1 - (1 - p)/2, over the pixels that all of them cover",
    "protocol_half": "the same at drop rate 1/2 for every model",
    "repeat": "protocol_half with other masks",
    "unconditioned": "the renders of protocol_half over the region of exact_half",
    "exact": "variance at the protocol's drop rate, over the pixels of expected alpha above 0.8",
    "exact_half": "the same at drop rate 1/2 for every model",
    "limit_conditioned": "the variance of exact_half over the region of protocol_half",
    "weighted_half": "the variance of exact_half over all pixels, weighted by their expected alpha",
    "neutral_half": "exact_half composited over the expected color instead of the background",
    "first_order_half": "the paper's formula p (1 - p) sum (c alpha)^2 at drop rate 1/2, over the region of exact_half",
}
"""The scores that are compared, in the order of the tables."""

_HALF = 0.5


@torch.no_grad()
def score_view(model: TrainedModel, view: View, *, index: int) -> dict[str, float]:
    """Measure all variants at one view.

    Args:
        model: what to measure.
        view: a view on the model's device.
        index: its position in its split, which decides the masks as it does in `evaluate`.

    Returns:
        PSNR of the test-time render, every variant by name, and under ``"visible NAME"`` the share of the pixels in
        the region of the variants that have one of their own; nan where the region of a variant is empty.
    """
    opacities = model.gaussians.opacities
    moments = read_moments(model.moments(opacities, view, Multiplier.dropout(_HALF)), layout="CHW")
    assert moments.alpha_mean is not None
    exact_half = CAScore.exact(lambda *_: moments, drop_rate=_HALF)(opacities, view)
    half = model.ca_score(drop_rate=_HALF)(opacities, view, index=index)
    repeat = model.ca_score(drop_rate=_HALF, seed=1)(opacities, view, index=index)
    neutral = model.exact_ca_score(drop_rate=_HALF, neutral=True)(opacities, view)
    if model.dropout > 0:
        protocol = model.ca_score()(opacities, view, index=index)
        exact = model.exact_ca_score()(opacities, view)
    else:
        protocol, exact = half, exact_half
    results = {
        "protocol": protocol,
        "protocol_half": half,
        "repeat": repeat,
        "exact": exact,
        "exact_half": exact_half,
        "neutral_half": neutral,
    }
    values = {name: result.value for name, result in results.items()}
    values["unconditioned"] = _average(half.variance, exact_half.visible)
    values["limit_conditioned"] = _average(exact_half.variance, half.visible)
    values["weighted_half"] = _average(exact_half.variance, moments.alpha_mean)
    first_order = first_order_map(model.splats(opacities, view), Multiplier.dropout(_HALF)).mean(0)
    values["first_order_half"] = _average(first_order, exact_half.visible)
    image = model.test_rendering(view).image.clamp(0, 1)
    return {
        "psnr": psnr(image, view.image, view.mask),
        **{name: values[name] for name in VARIANTS},
        **{
            f"visible {name}": result.visible.double().mean().item()
            for name, result in results.items()
            if result is not neutral  # the region of exact_half
        },
    }


def _average(values: Tensor, weights: Tensor) -> float:
    """Average (H, W) with weights, or over a region; nan where all weights are 0."""
    weights = weights.double()
    total = weights.sum()
    return ((values.double() * weights).sum() / total).item() if total > 0 else math.nan


_IN_LABEL = ("views", "images", "downscale", "seed", "dropout", "noise", "regularizer")

_FIVE_OF_LIMIT = 0.8
"""What a population variance of 5 renders is of the variance in expectation; exact scores know no such factor."""

_HOW_TO_READ = """\
Scores are in units of 1e-3, means over the views that have a value ("2/3": two of three views have one, the others no
visible pixel). Correlations are over the runs of one scene; more than a few runs are needed for them to mean anything.

`drop rate` is exact / exact_half: what the protocol's drop rate, which depends on the training, does to the score.
`sampling` is unconditioned / exact_half, the sampling error alone: its expectation is 1. `region` is
limit_conditioned / exact_half: the same exact variance over the pixels that all five renders cover. `selection` is
protocol_half / limit_conditioned: on these pixels, five renders that leave no hole against all. `region` x `selection`
is what the protocol makes of its limit at drop rate 1/2. `neutral` is neutral_half / exact_half: what remains of the
score when holes show no background. The factor (K - 1)/K of the population variance is taken out of all of them.
"""


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/ranking"),
    split: Literal["test", "train"] = "test",
    views: int | None = None,
    device: str = "cpu",
) -> None:
    """Compare how the variants of the score rank the same models: rank correlations, disagreements, and why.

    Args:
        runs: folders of runs; those of one scene are compared with each other.
        out: folder for the JSON, the tables and the figure; what is in it is not measured again.
        split: which views.
        views: only the first so many.
        device: "cpu" or "cuda".
    """
    with log_shown():
        run_study(ranking_study(runs, split=split, views=views, device=device), out)


def ranking_study(runs: Sequence[Path], *, split: str = "test", views: int | None = None, device: str = "cpu") -> Study:
    """Declare the study: all variants on every run; those of one scene are compared with each other.

    Args:
        runs: folders of runs.
        split: ``"train"`` or ``"test"``: which views to measure.
        views: measure only the first so many; None for all.
        device: where to render.

    Raises:
        ValueError: if there is no run, no such split, or no view to measure.
        FileNotFoundError: if a folder holds no run.
    """
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', got {split!r}.")
    if views is not None and views < 1:
        raise ValueError(f"views must be at least 1, or None for all, got {views}.")
    settings = {"split": split, "views": views, "device": device}
    cases = {name: {"checkpoint": file, **settings} for name, file in checkpoints(runs).items()}
    return Study("ranking", _measure, cases, _report, _plot)


def _measure(checkpoint: Path, split: str, views: int | None, device: str) -> Record:
    """Measure all variants on the views of a run; under ``views`` the name and the quantities of `score_view` of each.

    Raises:
        ValueError: if the split has no view.
    """
    run = checkpoint.parent
    trainer = load_run(run, device)
    members = (trainer.scene.train if split == "train" else trainer.scene.test)[:views]
    if not members:
        raise ValueError(f"{run} has no {split} views to measure.")
    model = model_of(trainer)
    options, _ = read_run_settings(run / CONFIG)
    settings = dataclasses.asdict(options) | dataclasses.asdict(trainer.config)
    return {
        "scene": _scene(trainer.scene.name, options),
        "split": split,
        "strategy": run.parent.name if run.name.startswith("seed_") else trainer.config.regularizers or "baseline",
        "training_views": len(trainer.scene.train),
        "seed": trainer.config.seed,
        "settings": {name: value for name, value in settings.items() if name not in _IN_LABEL},
        "gaussians": len(model.gaussians),
        "views": [{"name": view.name, **score_view(model, view.to(device), index=i)} for i, view in enumerate(members)],
    }


def _scene(name: str, options: SceneOptions) -> str:
    """Name a scene with what decides its resolution."""
    smaller = f"1/{options.downscale:g}" if options.downscale not in (None, 1) else None
    size = ", ".join(text for text in (options.images, smaller) if text is not None)
    return f"{name} ({size})" if size else name


def mean_of(run: Record, quantity: str) -> float:
    """Return the mean over the views that have the quantity; nan if none has.

    Example:
        >>> mean_of({"views": [{"exact": 0.5}, {"exact": math.nan}]}, "exact")
        0.5
    """
    return mean_std(view[quantity] for view in run["views"])[0]


def _scenes(records: Records) -> dict[str, list[Record]]:
    """Return the runs of each scene by their exact score; those without one (nan compares with nothing) last."""
    runs = sorted(records.values(), key=lambda run: (math.isnan(exact := mean_of(run, "exact")), exact))
    return {scene: [run for run in runs if run["scene"] == scene] for scene in sorted({run["scene"] for run in runs})}


def group_labels(runs: Sequence[Record]) -> list[str]:
    """Name what each run of a scene shares with its other seeds: strategy, views, and what its namesakes differ in.

    The strategy is the folder of the seeds, as `compare` has it, else the regularizers; views are said if they differ.

    Args:
        runs: of one scene.

    Returns:
        One label per run; equal for runs that differ in their seed only.

    Example:
        >>> run = {"strategy": "noise", "training_views": 3}
        >>> runs = [run | {"settings": {"iterations": n}} for n in (1000, 2000)]
        >>> group_labels(runs)[1], group_labels(runs[:1])
        ('noise, iterations 2000', ['noise'])
    """
    names = dict.fromkeys(name for run in runs for name in run["settings"])
    several = len({run["training_views"] for run in runs}) > 1
    labels = []
    for run in runs:
        alike = [other["settings"] for other in runs if other["strategy"] == run["strategy"]]
        differ = [name for name in names if len({json.dumps(other.get(name)) for other in alike}) > 1]
        # What is off or left to the program needs no word; the others of the scene have one.
        said = {name: value for name in differ if (value := run["settings"].get(name)) not in (False, None, "auto")}
        words = [name if value is True else f"{name} {value}" for name, value in said.items()]
        labels.append(", ".join([run["strategy"], *[f"{run['training_views']} views"] * several, *words]))
    return labels


def correlations(runs: Sequence[Record]) -> dict[str, dict[str, float | None]]:
    """Return the rank correlations of every variant with ``exact_half``, ``protocol`` and the test-time PSNR.

    Args:
        runs: of one scene.

    Returns:
        By variant: ``"rho WHAT"`` (Spearman) and ``"tau WHAT"`` (Kendall's tau-b) over the runs that have both values,
        None where there is no order to compare.
    """
    from scipy.stats import kendalltau, spearmanr  # a second to import

    out: dict[str, dict[str, float | None]] = {}
    for variant in VARIANTS:
        out[variant] = {}
        for reference in ("exact_half", "protocol", "psnr"):
            pairs = [(mean_of(run, variant), mean_of(run, reference)) for run in runs]
            known = [pair for pair in pairs if all(map(math.isfinite, pair))]
            x, y = [a for a, _ in known], [b for _, b in known]
            ordered = len({*x}) > 1 and len({*y}) > 1
            for name, correlation in (("rho", spearmanr), ("tau", kendalltau)):
                out[variant][f"{name} {reference}"] = float(correlation(x, y).statistic) if ordered else None
    return out


def disagreements(runs: Sequence[Record]) -> list[dict[str, str]]:
    """Return the pairs of strategies that not all variants order in the same way, by their means over seeds.

    Args:
        runs: of one scene.

    Returns:
        For each pair its name under ``"A / B"`` and by variant the ratio of the means of A and B, in bold where every
        seed of the one is below every seed of the other (given two seeds each); ``"n/a"`` without a value.
    """
    members: dict[str, list[Record]] = {}
    for label, run in zip(group_labels(runs), runs, strict=True):
        members.setdefault(label, []).append(run)
    rows = []
    for (one, first), (other, second) in itertools.combinations(members.items(), 2):
        row, signs = {"A / B": f"{one} / {other}"}, set()
        for variant in VARIANTS:
            scores = ([mean_of(run, variant) for run in group] for group in (first, second))
            a, b = ([x for x in of if math.isfinite(x)] for of in scores)
            ratio = _ratio(mean_std(a)[0], mean_std(b)[0])
            if not math.isfinite(ratio):
                row[variant] = "n/a"
                continue
            signs.add((ratio > 1) - (ratio < 1))
            apart = min(len(a), len(b)) > 1 and (max(a) < min(b) or max(b) < min(a))
            row[variant] = f"**{ratio:.3g}**" if apart else f"{ratio:.3g}"
        if len(signs) > 1:
            rows.append(row)
    return rows


def _report(records: Records) -> str:
    """Return all tables, a section for each scene."""
    variants = list(VARIANTS)
    split = next(iter(records.values()))["split"]
    parts = [
        f"# How the variants of the CA score rank the same models ({split} views)",
        "\n".join(f"- `{name}`: {text}" for name, text in VARIANTS.items()),
        _HOW_TO_READ.strip(),
    ]
    for scene, runs in _scenes(records).items():
        labels = [f"{label}, seed {run['seed']}" for label, run in zip(group_labels(runs), runs, strict=True)]
        scores = [
            {"run": label, "PSNR": mean_of(run, "psnr"), "Gaussians": run["gaussians"]}
            | {variant: _score_cell(run, variant) for variant in variants}
            for label, run in zip(labels, runs, strict=True)
        ]
        reasons = [{"run": label, **_reasons(run)} for label, run in zip(labels, runs, strict=True)]
        correlation = [{"variant": name, **row} for name, row in correlations(runs).items()]
        counts = sorted({len(run["views"]) for run in runs})
        parts += [
            f"## {scene}: {len(runs)} runs, {' or '.join(map(str, counts))} views",
            markdown_table(scores, list(scores[0])),
            "Why the protocol differs from its limit:",
            markdown_table(reasons, list(reasons[0])),
            "Rank correlations (rho: Spearman, tau: Kendall's tau-b):",
            markdown_table(correlation, list(correlation[0])),
        ]
        if different := disagreements(runs):
            parts += [
                "Strategies that the variants order differently: score of A over score of B, means over seeds; bold "
                "where no two seeds contradict it:",
                markdown_table(different, list(different[0])),
            ]
        else:
            parts.append("All variants order the means of the strategies in the same way.")
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


_DRAWN = {"protocol_half": ("CA of 5 renders", _FIVE_OF_LIMIT), "neutral_half": ("neutral exact CA", 1.0)}


def _plot(records: Records, figure: Any) -> None:
    """Plot the protocol and the neutral score against the exact one, all at drop rate 1/2; a row for each scene."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    scenes = _scenes(records)
    named = {scene: group_labels(runs) for scene, runs in scenes.items()}
    order = {label: i for i, label in enumerate(sorted({label for labels in named.values() for label in labels}))}
    figure.set_size_inches(WIDTH, 4.6 * len(scenes))
    grid = figure.subplots(len(scenes), 2, squeeze=False)
    for row, (scene, runs) in zip(grid, scenes.items(), strict=True):
        labels = named[scene]
        for ax, (quantity, (name, share)) in zip(row, _DRAWN.items(), strict=True):
            for label in sorted(set(labels)):
                group = [run for run, of in zip(runs, labels, strict=True) if of == label]
                x, y = ([mean_of(run, score) * 1e3 for run in group] for score in ("exact_half", quantity))
                look = {"color": color(label, order[label]), "marker": "osD^vP*X<>p"[order[label] % 11]}
                ax.scatter(x, y, label=readable(label), **look)
            title = " (".join([readable(scene.partition(" (")[0]), *scene.split(" (")[1:]])
            ax.set(xscale="log", yscale="log", title=title, xlabel="exact CA (10⁻³)", ylabel=f"{name} (10⁻³)")
            ax.axline(
                (1, share),
                (2, 2 * share),
                color="0.7",
                linewidth=1,
                zorder=0,
                label=f"{share:g} times the exact score" if share < 1 else "equal",
            )
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7)))
                axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axis.set_minor_locator(NullLocator())
        row[0].legend(*([x[-1]] for x in row[0].get_legend_handles_labels()), loc="upper left")
        row[1].legend(loc="lower right", fontsize=8.5)


def _score_cell(run: Record, variant: str) -> str | None:
    """Write a score in units of 1e-3, and how many views have one if not all do."""
    value, views = mean_of(run, variant), len(run["views"])
    missing = sum(not math.isfinite(view[variant]) for view in run["views"])  # no pixel is visible
    if not math.isfinite(value):
        return None
    return f"{value * 1e3:.4g}" + (f" ({views - missing}/{views})" if missing else "")


def _reasons(run: Record) -> dict[str, float]:
    """Return the regions and the factors between the protocol, its limit and the neutral score, at drop rate 1/2."""
    exact = mean_of(run, "exact_half")
    return {
        "visible protocol": mean_of(run, "visible protocol"),
        "visible protocol_half": mean_of(run, "visible protocol_half"),
        "visible exact_half": mean_of(run, "visible exact_half"),
        "drop rate": _ratio(mean_of(run, "exact"), exact),
        "sampling": _ratio(mean_of(run, "unconditioned"), exact * _FIVE_OF_LIMIT),
        "region": _ratio(mean_of(run, "limit_conditioned"), exact),
        "selection": _ratio(mean_of(run, "protocol_half"), mean_of(run, "limit_conditioned") * _FIVE_OF_LIMIT),
        "neutral": _ratio(mean_of(run, "neutral_half"), exact),
    }


def _ratio(a: float, b: float) -> float:
    """Divide two scores; nan where there is no ratio."""
    return a / b if b > 0 else math.nan


if __name__ == "__main__":
    tyro.cli(main)
