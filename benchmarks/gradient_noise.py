"""What sampling costs the gradient: one training step with random masks against the step in expectation.

``python -m benchmarks.gradient_noise RUN ...``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from benchmarks.gradient_noise_moments import (
    ALL,
    CANDIDATES,
    LOSSES,
    DrawMoments,
    GradientNoise,
    Gradients,
    Moments,
    StepNoise,
    dot,
)
from ca_reg.functional import Multiplier, apply_dropout, draw_keep_mask, expected_squared_error
from reference_trainer.cli import log_shown
from reference_trainer.evaluation.tables import format_mean_std, markdown_table
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians, render_moments_of
from reference_trainer.runs.run import load_run
from reference_trainer.scenes.scene import View
from reference_trainer.studies.study import Record, Records, Study, checkpoints, now, run_study
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import expected_photometric_loss, photometric_loss
from reference_trainer.training.randomness import stream

__all__ = [
    "gradient_noise",
    "gradient_noise_figure",
    "gradient_noise_report",
    "gradient_noise_study",
    "gradient_noise_table",
]

_HOW_TO_READ = """\
Gradients of one step at fixed parameters. `mu` is the expectation over the masks, g a sampled gradient, V its trace
variance; |mu|^2 is estimated without the upward bias V / K of the mean of K draws. Groups have different units, so each
row stands for itself; `all` is the plain concatenation, in which the group with the largest gradients prevails.
Mean ± deviation is over the training views.

First table, photometric loss, for a step that picks a view at random. `V / |mu|^2`: noise of the mask at one view.
The others are relative to the squared length of the gradient that is expected over the views too: `masks` is the mean
of V, `views` the variance between the expected gradients of the views, `sampled` their sum, `analytic` what is left
without masks. `share of masks` is masks / (masks + views). n/a: the squared length is not above 0 in so few draws.

Second table. `cosine`: between the analytic gradient and the mean of the draws. `ceiling`: what the true expectation
would reach on average, from the cosine r of two halves of the draws as sqrt(2 r / (1 + r)) (Spearman-Brown).
`length`: |analytic| / |mu| - 1. `error`: |analytic - mu|^2 / |mu|^2, unbiased, so around 0 (of either sign) if there
is none. `worth`: the number of draws whose average is as far from mu as the analytic gradient is, sum of V / sum of
|analytic - mu|^2 over the views; n/a if no distance was found. `control` is the plain loss of the render with scaled
opacities, without a variance term.

Third table, squared error, where the analytic gradient is the expectation: the distance of the mean of k draws from it,
in units of |mu|, falls as sqrt(V / k) if it is. The k are those of one growing average.
"""


def gradient_noise_report(results: Mapping[str, GradientNoise]) -> str:
    """Return how to read the tables, and a section for each run, in Markdown.

    Args:
        results: by the name of the run.
    """
    sections = [f"## {name}\n\n{gradient_noise_table(result)}" for name, result in results.items()]
    return "\n".join(["# What sampling costs the gradient\n", _HOW_TO_READ, *sections])


def gradient_noise_table(result: GradientNoise) -> str:
    """Return the three tables of one run, and the time of a step, in Markdown."""
    groups = result.groups()
    noise = [
        {
            "group": group,
            "V / |mu|^2": format_mean_std(m.relative_noise for m in result.over_views("photometric", group)),
            **result.steps["photometric"][group].relative(),
            "share of masks": f"{result.steps['photometric'][group].share_of_masks:.1%}",
        }
        for group in groups
    ]
    nearness: list[dict[str, object]] = []
    for loss in LOSSES:
        for group in groups:
            views = result.over_views(loss, group)
            row: dict[str, object] = {
                "loss, group": f"{loss}, {group}",
                "ceiling": format_mean_std(m.ceiling for m in views),
            }
            for what in CANDIDATES:
                row |= {
                    f"cosine {what}": format_mean_std(m.cosine(what) for m in views),
                    f"length {what}": format_mean_std(m.length(what) for m in views),
                    f"error {what}": format_mean_std(m.error(what) for m in views),
                    f"worth {what}": Moments.total(views).worth(what),
                }
            nearness.append(row)
    law = [
        {"group": group} | {f"k = {k}": f"{measured:.3g} ({exact:.3g})" for k, measured, exact in result.law(group)}
        for group in groups
    ]
    sampled, analytic = result.seconds()
    draws = result.over_views("squared", groups[0])[0].draws
    return "\n".join(
        [
            f"{result.gaussians} Gaussians, {len(result.views)} training views, dropout {result.dropout:g}, "
            f"K = {draws} draws.\n",
            markdown_table(noise, list(noise[0])),
            markdown_table(nearness, list(nearness[0])),
            "Measured distance (expected one if the analytic gradient is the expectation), mean over the views:\n",
            markdown_table(law, list(law[0])),
            f"- One step, forward and backward: sampled {sampled:.3g} s, analytic {analytic:.3g} s, ratio "
            f"{analytic / sampled:.2f}.",
            f"- Two evaluations of the analytic gradient {'agree' if result.repeats else 'do not agree'} bit by bit.",
            "",
        ]
    )


def gradient_noise_figure(results: Mapping[str, GradientNoise], figure: Any) -> None:
    """Plot the relative noise of a sampled and of an analytic step for every group, one panel per run.

    Args:
        results: by the title of the panel.
        figure: an empty one of matplotlib.
    """
    figure.set_size_inches(6 * len(results), 4.5)
    panels = figure.subplots(1, len(results), squeeze=False)[0]
    for axes, (name, result) in zip(panels, results.items(), strict=True):
        groups = result.groups()
        parts = [result.steps["photometric"][group].relative() for group in groups]
        # A variance that was estimated below 0 has no bar.
        masks, views, analytic = ([max(part[key], 0.0) for part in parts] for key in ("masks", "views", "analytic"))
        left, right = ([i + shift for i in range(len(groups))] for shift in (-0.2, 0.2))
        axes.bar(left, views, 0.38, color="C0", label="sampled: choice of the view")
        axes.bar(left, masks, 0.38, bottom=views, color="C1", label="sampled: masks")
        axes.bar(right, analytic, 0.38, color="C2", label="analytic: choice of the view")
        axes.set_xticks(range(len(groups)), groups, rotation=25, ha="right")
        axes.set(title=name, ylabel="variance / squared expectation of the gradient")
        axes.grid(axis="y", alpha=0.3)
    lines = dict(zip(*reversed(panels[-1].get_legend_handles_labels()), strict=True))
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize="small")


ROUNDS = 5  # how often each kind of step is timed at every view


def main(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("runs/gradient_noise"),
    draws: int = 64,
    dropout: float = 0.2,
    device: str = "cpu",
) -> None:
    """Measure what sampling masks costs the gradient of a training step, against the analytic gradient.

    Args:
        runs: folders of runs.
        out: folder for the JSON, the tables and the figure; what is in it is not measured again.
        draws: masks at every training view, a power of two.
        dropout: rate of the masks.
        device: "cpu" or "cuda".
    """
    with log_shown():
        run_study(gradient_noise_study(runs, draws=draws, dropout=dropout, device=device), out)


def gradient_noise_study(runs: Sequence[Path], *, draws: int = 64, dropout: float = 0.2, device: str = "cpu") -> Study:
    """Declare the study of trained runs.

    Every run is measured at the parameters of its checkpoint and its training views, under plain dropout (without
    compensation and noise) whatever it was trained with.

    Args:
        runs: folders of runs.
        draws: number K of masks at every view, a power of two of at least 4.
        dropout: drop rate of the masks, in (0, 1).
        device: where to render.

    Raises:
        ValueError: if there is no run, or a setting is out of range.
        FileNotFoundError: if a folder holds no run.
    """
    _check(draws, dropout)
    settings = {"draws": draws, "dropout": dropout, "device": device}
    cases = {name: {"checkpoint": file, **settings} for name, file in checkpoints(runs).items()}

    def results(records: Records) -> dict[str, GradientNoise]:
        return {name: GradientNoise.from_dict(record) for name, record in records.items()}

    return Study(
        "gradient_noise",
        _measure,
        cases,
        lambda records: gradient_noise_report(results(records)),
        lambda records, figure: gradient_noise_figure(results(records), figure),
    )


def _measure(checkpoint: Path, draws: int, dropout: float, device: str) -> Record:
    """Measure a run."""
    trainer = load_run(checkpoint.parent, device)
    config = replace(trainer.config, dropout=dropout, noise=0.0, regularizer="")
    model = (trainer.gaussians, trainer.background, config, trainer.views)
    result = gradient_noise(*model, sh_degree=trainer.sh_degree, draws=draws)
    return {"summary": result.summary(), **asdict(result)}


def gradient_noise(
    gaussians: Gaussians,
    background: Tensor,
    config: TrainConfig,
    views: Sequence[View],
    *,
    sh_degree: int,
    draws: int = 64,
) -> GradientNoise:
    """Measure what masks do to the gradient of a step at fixed parameters, and what is left without them.

    Args:
        gaussians: the model.
        background: color behind it, shape (3,).
        config: dropout rate, without noise; seed of the masks; weight of D-SSIM.
        views: to train on, with different names.
        sh_degree: highest band of spherical harmonics to use.
        draws: number K of masks at every view, a power of two of at least 4.

    Returns:
        All measurements. The groups are the parameters, the two sets of spherical harmonics taken as one: at one view
        their gradients are proportional to each other.

    Raises:
        ValueError: if ``draws`` is out of range, or the configuration is not one of plain dropout.
    """
    _check(draws, config.dropout)
    if config.noise != 0 or config.regularizer:
        raise ValueError("expected plain dropout: leave out noise and other regularizers.")
    model = gaussians.map(lambda x: x.detach().requires_grad_())
    found: dict[str, dict[str, dict[str, Moments]]] = {}
    sums: dict[str, list[Gradients]] = {loss: [{}, {}] for loss in LOSSES}  # of means of the draws, of analytic ones
    times: tuple[list[list[float]], list[list[float]]] = ([], [])
    repeats = True
    for index, view in enumerate(views):
        step = _Step(model, background, config, sh_degree, view)
        generator = stream(config.seed, index, "gradient noise")
        analytic, again, control = step.analytic(), step.analytic(), step.control()
        repeats &= all(torch.equal(x, again[loss][name]) for loss in LOSSES for name, x in analytic[loss].items())
        moments = {loss: DrawMoments(analytic[loss]) for loss in LOSSES}
        for _ in range(draws):
            for loss, gradients in step.sampled(generator).items():
                moments[loss].add(gradients)
        for loss in LOSSES:
            for total, gradients in zip(sums[loss], (moments[loss].mean(), analytic[loss]), strict=True):
                for name, x in gradients.items():
                    total[name] = total[name] + x.double() if name in total else x.double()
        found[view.name] = {loss: moments[loss].result(control[loss]) for loss in LOSSES}
        for seconds, taken in zip(times, step.seconds(generator), strict=True):
            seconds.append(taken)
    steps = {loss: _over_views([losses[loss] for losses in found.values()], *sums[loss]) for loss in LOSSES}
    for losses in found.values():
        for groups in losses.values():
            groups[ALL] = Moments.total(list(groups.values()))
    return GradientNoise(len(gaussians), config.dropout, found, steps, repeats, *times)


def _over_views(views: Sequence[dict[str, Moments]], sampled: Gradients, analytic: Gradients) -> dict[str, StepNoise]:
    """Combine the moments of all views with the sums over views of the mean of the draws and the analytic gradient."""
    steps = {}
    for name, total in sampled.items():
        squared, analytic_squared = (dot(x, x) / len(views) ** 2 for x in (total, analytic[name]))
        steps[name] = StepNoise.of([groups[name] for groups in views], squared, analytic_squared)
    return {**steps, ALL: StepNoise.total(list(steps.values()))}


class _Step:
    """One training step on a view at fixed parameters, by the kind of its gradient."""

    def __init__(
        self, gaussians: Gaussians, background: Tensor, config: TrainConfig, sh_degree: int, view: View
    ) -> None:
        self.gaussians, self.background, self.config = gaussians, background, config
        self.sh_degree, self.view = sh_degree, view

    def sampled(self, generator: torch.Generator) -> dict[str, Gradients]:
        """Return the gradients of both losses under one mask."""
        return {loss: self._gradient(value) for loss, value in self._losses(self._draw(generator)).items()}

    def control(self) -> dict[str, Gradients]:
        """Return the gradients of the plain losses of the render with scaled opacities."""
        scaled = self.gaussians.opacities * (1 - self.config.dropout)
        return {loss: self._gradient(value) for loss, value in self._losses(self._render(scaled)).items()}

    def analytic(self) -> dict[str, Gradients]:
        """Return the gradients of both losses in expectation."""
        image, variance = self._expectation()
        squared = expected_squared_error(image, variance, self.view.image).mean()
        photometric = expected_photometric_loss(image, variance, self.view.image)
        losses = {"photometric": photometric, "squared": squared}
        return {loss: self._gradient(losses[loss]) for loss in LOSSES}

    def seconds(self, generator: torch.Generator) -> tuple[list[float], list[float]]:
        """Time forward and backward of the photometric loss of a sampled and of an analytic step, in turns."""
        target = self.view.image
        calls: tuple[Callable[[], Tensor], Callable[[], Tensor]] = (
            lambda: photometric_loss(self._draw(generator), target),
            lambda: expected_photometric_loss(*self._expectation(), target),
        )
        taken: tuple[list[float], list[float]] = ([], [])
        for _ in range(ROUNDS):
            for call, seconds in zip(calls, taken, strict=True):
                start = now(target.device)
                self._gradient(call())
                seconds.append(now(target.device) - start)
        return taken

    def _draw(self, generator: torch.Generator) -> Tensor:
        """Render with one mask."""
        opacities = self.gaussians.opacities
        keep = draw_keep_mask(len(opacities), self.config.dropout, generator=generator, device=opacities.device)
        return self._render(apply_dropout(opacities, keep))

    def _render(self, opacities: Tensor) -> Tensor:
        """Render with given opacities."""
        camera = self.view.camera
        return render_gaussians(
            self.gaussians, camera, self.background, opacities=opacities, sh_degree=self.sh_degree
        ).image

    def _expectation(self) -> tuple[Tensor, Tensor]:
        """Render mean and variance."""
        camera, multiplier = self.view.camera, Multiplier.dropout(self.config.dropout)
        out, _ = render_moments_of(self.gaussians, multiplier, camera, self.background, sh_degree=self.sh_degree)
        return out.mean, out.variance

    def _losses(self, image: Tensor) -> dict[str, Tensor]:
        """Return both losses of an image."""
        photometric = photometric_loss(image, self.view.image)
        return {"photometric": photometric, "squared": (image - self.view.image).square().mean()}

    def _gradient(self, loss: Tensor) -> Gradients:
        """Return the gradient by group; the graph is kept for another loss."""
        leaves = dict(self.gaussians.named())
        found = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
        gradients = dict(zip(leaves, found, strict=True))
        gradients["sh"] = torch.cat([gradients.pop("sh_dc"), gradients.pop("sh_rest")], dim=1)
        return gradients


def _check(draws: int, dropout: float) -> None:
    """Raise unless the settings are in range."""
    if draws < 4 or draws & (draws - 1):
        raise ValueError(f"draws must be a power of two of at least 4, got {draws}.")
    if not 0 < dropout < 1:
        raise ValueError(f"dropout must lie between 0 and 1, got {dropout}: without masks there is nothing to sample.")


if __name__ == "__main__":
    tyro.cli(main)
