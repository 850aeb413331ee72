"""What an oracle would gain: how much test error lies where a model co-adapts, and who should go if one knew the error.

    python -m benchmarks.oracle RUN ...

It bounds what a scheme that the score guides can gain on a finished model; no scheme may look at test photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from kornia.color import rgb_to_grayscale
from kornia.filters import spatial_gradient
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.cli import log_shown
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.shares import blend_weights, mean_shares, share_per_weight
from reference_trainer.evaluation.tables import markdown_table, mean_std
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.runs.run import load_run, model_of
from reference_trainer.scenes.scene import View
from reference_trainer.studies.study import Record, Records, Study, checkpoints, run_study
from reference_trainer.training.randomness import stream

__all__ = ["CRITERIA", "best_factors", "error_slopes", "held", "oracle_study", "partial", "rank_correlation"]

CRITERIA = {
    "error, these views": "slope of the squared error of the test views in a factor of the opacity: the oracle",
    "error, other views": "the same of all test views but the one that is measured",
    "error, training views": "the same of the training views, which every scheme may know",
    "share": "highest share of the exact score at drop rate 1/2 at the test cameras, for which no photograph is needed",
    "share per weight": "the same, for what they contribute there",
    "opacity": "lowest opacity",
    "random": "the control",
}
"""Who goes first."""

PREDICTORS = {
    "exact CA": "variance of the colors at drop rate 1/2",
    "edges": "gradient of the render's gray values, for error and variance both lie at edges",
    "error": "the squared error itself: the best there is",
}
"""By what pixels are ordered."""

PARTS = (0.01, 0.05, 0.1, 0.2, 0.5)
FRACTIONS = (0.01, 0.02, 0.05, 0.1, 0.2)
ACTIONS = {"removed": 0.0, "halved": 0.5}
_HALF = 0.5
_POINTS = 50


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional], out: Path = Path("runs/oracle"), steps: int = 30
) -> None:
    """Measure finished runs: where the error lies, and what those gain who know it.

    Args:
        runs: folders of runs.
        out: folder for the JSON, the tables and the figure.
        steps: of the search for the best factors of the opacities.
    """
    with log_shown():
        run_study(oracle_study(runs, steps=steps), out)


def oracle_study(runs: Sequence[Path], *, steps: int = 30) -> Study:
    """Declare the study: a case for each run."""
    cases = {name: {"checkpoint": path, "steps": steps} for name, path in checkpoints(runs).items()}
    return Study("oracle", _measure, cases, _report, _plot)


def held(error: Tensor, predictor: Tensor, parts: Sequence[float]) -> list[float]:
    """Return which share of the error lies in these parts of the pixels, those first where the predictor is highest.

    Example:
        >>> held(torch.tensor([3.0, 1.0, 0.0, 0.0]), torch.tensor([1.0, 2.0, 0.0, 0.5]), [0.25, 0.5])
        [0.25, 1.0]
    """
    sums = error.flatten().double()[predictor.flatten().argsort(descending=True, stable=True)].cumsum(0)
    return [(sums[max(1, round(part * len(sums))) - 1] / sums[-1]).item() for part in parts]


def rank_correlation(a: Tensor, b: Tensor) -> float:
    """Return Spearman's correlation; equal values are ordered as they come.

    Example:
        >>> rank_correlation(torch.tensor([1.0, 2.0, 9.0]), torch.tensor([0.0, 5.0, 6.0]))
        1.0
    """
    ranks = torch.stack([x.flatten().argsort(stable=True).argsort().double() for x in (a, b)])
    return round(torch.corrcoef(ranks)[0, 1].item(), 12)


def partial(ab: float, ac: float, bc: float) -> float:
    """Return the correlation of a and b that is left when c is known.

    Example:
        >>> round(partial(0.5, 0.5, 1.0 - 1e-12), 3), partial(0.5, 0.0, 0.0)
        (0.0, 0.5)
    """
    return (ab - ac * bc) / math.sqrt((1 - ac**2) * (1 - bc**2))


def error_slopes(model: TrainedModel, views: Sequence[View]) -> Tensor:
    """Return the slope of the mean squared error in a factor of each opacity at 1, summed over views, shape (N,).

    Where it is positive a lower opacity lowers the error, to first order.
    """
    factors = torch.ones_like(model.test_opacities).requires_grad_()
    return torch.autograd.grad(_error(model, factors, views), factors)[0]


def best_factors(model: TrainedModel, views: Sequence[View], steps: int, rate: float = 0.05) -> Tensor:
    """Search for the factors in [0, 1] of the opacities, shape (N,), at which the views' squared error is least.

    A factor 1 - p is what a drop rate p of the Gaussian leaves of it on average. Adam, from 1 on.
    """
    factors = torch.ones_like(model.test_opacities).requires_grad_()
    optimizer = torch.optim.Adam([factors], rate, betas=(0.9, 0.99))
    for _ in range(steps):
        optimizer.zero_grad()
        _error(model, factors, views).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        with torch.no_grad():
            factors.clamp_(0, 1)
    return factors.detach()


def _error(model: TrainedModel, factors: Tensor, views: Sequence[View]) -> Tensor:
    opacities = model.test_opacities * factors
    errors = [(model.render(opacities, view)[0] - view.image).square().mean() for view in views]
    return torch.stack(errors).sum()


def _measure(checkpoint: Path, steps: int) -> Record:
    """Measure one run."""
    trainer = load_run(checkpoint.parent)
    model = model_of(trainer)
    test = [view.to(trainer.device) for view in trainer.scene.test]
    generator = stream(trainer.config.seed, trainer.step, "oracle", trainer.device)
    return {"pixels": _where(model, test), **_who(model, trainer.views, test, generator), **_rates(model, test, steps)}


@torch.no_grad()
def _where(model: TrainedModel, views: Sequence[View]) -> dict[str, Any]:
    """Return how well the predictors tell where the error is: means over the views."""
    parts = [i / _POINTS for i in range(1, _POINTS + 1)]
    found: dict[str, list[Any]] = {}
    for view in views:
        image = model.test_rendering(view).image
        moments = model.moments(model.gaussians.opacities, view, Multiplier.dropout(_HALF))
        error = (image.clamp(0, 1) - view.image).square().mean(0)
        edges = spatial_gradient(rgb_to_grayscale(image[None]))[0, 0].norm(dim=0)
        maps = dict(zip(PREDICTORS, (moments.variance.mean(0), edges, error), strict=True))
        for name, each in maps.items():
            found.setdefault(f"curve, {name}", []).append(held(error, each, parts))
            found.setdefault(f"held, {name}", []).append(held(error, each, PARTS))
        ca, edge, both = (
            rank_correlation(a, b) for a, b in ((maps["exact CA"], error), (edges, error), (maps["exact CA"], edges))
        )
        for name, value in (
            ("rank, exact CA", ca),
            ("rank, edges", edge),
            ("rank, CA beyond edges", partial(ca, both, edge)),
        ):
            found.setdefault(name, []).append([value])
    return {name: torch.tensor(values).mean(0).tolist() for name, values in found.items()}


def _who(
    model: TrainedModel, train: Sequence[View], test: Sequence[View], generator: torch.Generator
) -> dict[str, Any]:
    """Return the PSNR that is gained by lowering the opacities of some: by criterion, action and fraction."""
    ones = torch.ones_like(model.test_opacities)
    slopes = torch.stack([error_slopes(model, [view]) for view in test])
    shares = mean_shares(model, test, drop_rate=_HALF)[0]
    fixed = {
        "error, these views": slopes.sum(0),
        "error, training views": error_slopes(model, train),
        "share": shares,
        "share per weight": share_per_weight(shares, blend_weights(model, test)),
        "opacity": -model.test_opacities,
        "random": torch.rand(ones.shape, generator=generator, device=ones.device),
    }
    plain = _quality(model, [ones] * len(test), test)
    gains: dict[str, dict[str, list[float]]] = {}
    for criterion in CRITERIA:
        values = [fixed.get(criterion, slopes.sum(0) - own) for own in slopes]
        orders = [each.argsort(descending=True, stable=True) for each in values]
        for action, factor in ACTIONS.items():
            lowered = (
                [ones.index_fill(0, order[: round(fraction * len(order))], factor) for order in orders]
                for fraction in FRACTIONS
            )
            gains.setdefault(criterion, {})[action] = [_quality(model, each, test) - plain for each in lowered]
    return {"psnr": plain, "gaussians": len(ones), "gains": gains}


def _rates(model: TrainedModel, test: Sequence[View], steps: int) -> dict[str, float]:
    """Return what the best factors gain at the views they are found at, and at one that the search did not see."""
    ones = torch.ones_like(model.test_opacities)
    plain = _quality(model, [ones] * len(test), test)
    best = best_factors(model, test, steps)
    others = [best_factors(model, [view for view in test if view is not left], steps) for left in test]
    return {
        "rates, these views": _quality(model, [best] * len(test), test) - plain,
        "rates, other views": _quality(model, others, test) - plain,
        "mean factor": best.mean().item(),
    }


@torch.no_grad()
def _quality(model: TrainedModel, factors: Sequence[Tensor], views: Sequence[View]) -> float:
    """Return the mean PSNR of views, each with its own factors of the opacities."""
    plain = model.test_opacities
    images = [model.render(plain * each, view)[0] for each, view in zip(factors, views, strict=True)]
    return mean_std(psnr(image.clamp(0, 1), view.image) for image, view in zip(images, views, strict=True))[0]


def _report(records: Records) -> str:
    """Return the tables."""
    pixels, who, rates = [], [], []
    for run, record in records.items():
        where = record["pixels"]
        pixels += [
            {"run": run, "ordered by": name}
            | {f"{part:.0%}": f"{value:.1%}" for part, value in zip(PARTS, where[f"held, {name}"], strict=True)}
            | {"rank correlation": f"{where[f'rank, {name}'][0]:.3f}" if f"rank, {name}" in where else ""}
            | {"beyond edges": f"{where['rank, CA beyond edges'][0]:.3f}" if name == "exact CA" else ""}
            for name in PREDICTORS
        ]
        who += [
            {"run": run, "who": criterion, "what": action}
            | {f"{fraction:.0%}": f"{gain:+.3f}" for fraction, gain in zip(FRACTIONS, gains, strict=True)}
            for criterion, by_action in record["gains"].items()
            for action, gains in by_action.items()
        ]
        names = ("psnr", "rates, these views", "rates, other views", "mean factor")
        rates.append({"run": run, "Gaussians": record["gaussians"]} | {name: f"{record[name]:.3f}" for name in names})
    parts = [
        "# Oracles",
        "## Where the error is\n\nShare of the squared test error in the first pixels; mean over the test views.",
        *("\n".join(f"- {name}: {text}" for name, text in lines.items()) for lines in (PREDICTORS,)),
        markdown_table(pixels, list(pixels[0])).rstrip(),
        "## Who should go\n\nTest PSNR gained, dB.",
        "\n".join(f"- {name}: {text}" for name, text in CRITERIA.items()),
        markdown_table(who, list(who[0])).rstrip(),
        "## Best factors of the opacities, a rate for each Gaussian\n\nTest PSNR gained, dB.",
        markdown_table(rates, list(rates[0])).rstrip(),
    ]
    return "\n\n".join(parts) + "\n"


def _plot(records: Records, figure: Any) -> None:
    """Plot, in a row for each run, where the error is, and what is gained by removing and by halving."""
    figure.set_size_inches(13, 3.6 * len(records))
    grid = figure.subplots(len(records), 3, squeeze=False)
    for (run, record), (left, *panels) in zip(records.items(), grid, strict=True):
        parts = [100 * i / _POINTS for i in range(_POINTS + 1)]
        for name in PREDICTORS:
            left.plot(parts, [0.0, *(100 * x for x in record["pixels"][f"curve, {name}"])], label=name)
        left.plot([0, 100], [0, 100], color="0.6", linestyle=":", label="random")
        left.set(title=run, xlabel="pixels (%)", ylabel="squared test error held (%)")
        for ax, action in zip(panels, ACTIONS, strict=True):
            for number, (criterion, gains) in enumerate(record["gains"].items()):
                ax.plot([100 * x for x in FRACTIONS], gains[action], marker="osD^v*x"[number], label=criterion)
            ax.axhline(0, color="0.6", linewidth=0.8)
            ax.set_ylim(-3, None)
            ax.set(title=action, xlabel="Gaussians (%)", ylabel="test PSNR gained (dB)")
        for ax in (left, *panels):
            ax.grid(linewidth=0.3)
    grid[0][0].legend(fontsize=8)
    figure.legend(*grid[0][1].get_legend_handles_labels(), loc="outside lower center", ncols=len(CRITERIA), fontsize=8)


if __name__ == "__main__":
    tyro.cli(main)
