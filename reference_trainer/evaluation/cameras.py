"""Measure a model where no photographs are: co-adaptation and colour variance from given cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAResult
from reference_trainer.camera import Camera
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE, mean_over
from reference_trainer.evaluation.kept import KeptRecords
from reference_trainer.evaluation.pictures import PANEL, heat_map, save_png, side_by_side
from reference_trainer.evaluation.results import machine
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render.statistics import color_variance_map
from reference_trainer.scenes.scene import View

__all__ = ["CameraEvaluation", "CameraScores", "evaluate_cameras"]


@dataclass(frozen=True)
class CameraScores:
    """What was measured from one camera; nan where a quantity does not exist.

    ``ca``, ``ca_std_error``, ``ca_exact``, ``visible`` and ``cv`` are those of `ViewScores`; ``ca_neutral`` is the
    exact score with every pixel over its own expected colour, which the background has no part in; ``covered`` is the
    mean alpha of the render; ``ca_reason`` says why ``ca`` is nan, if it is.
    """

    name: str
    ca: float
    ca_std_error: float
    ca_exact: float
    ca_neutral: float
    cv: float
    visible: float
    covered: float
    ca_reason: str


@dataclass(frozen=True)
class CameraEvaluation:
    """Scores of all cameras and their means."""

    views: list[CameraScores]

    def mean(self, quantity: str) -> float:
        """Return the mean of a quantity over the cameras that have it, see `mean_over`; nan if none has."""
        return mean_over(self.views, quantity)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data, for JSON."""
        quantities = [name for name in CameraScores.__dataclass_fields__ if name not in ("name", "ca_reason")]
        return {
            "mean": {name: self.mean(name) for name in quantities},
            "views": [asdict(view) for view in self.views],
        }


@torch.no_grad()
def evaluate_cameras(
    model: TrainedModel,
    cameras: Sequence[Camera],
    *,
    samples: int = 5,
    seed: int = 0,
    pictures: Path | None = None,
    keep: Path | None = None,
    progress: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> CameraEvaluation:
    """Measure a model from cameras without photographs.

    Args:
        model: what to measure.
        cameras: on the model's device.
        samples: K of the CA score.
        seed: of the CA score's masks.
        pictures: a folder for two PNG files per camera, the render and a panel of it with the variance of the protocol,
            the exact variance and the neutral one; None for no pictures.
        keep: a file for the scores of the cameras that are done, as of `evaluate`.
        progress: whether to show a progress bar.
        say: receives what became of the scores that were kept.

    Returns:
        Scores per camera.
    """
    from tqdm import tqdm

    opacities, nothing = model.gaussians.opacities, model.background[:, None, None]
    score, exact = model.ca_score(samples=samples, seed=seed), model.exact_ca_score()
    neutral = model.exact_ca_score(neutral=True)
    kept = KeptRecords(keep, (model, list(cameras), samples, seed, machine()), say)
    names = [f"{index:03d}" for index in range(len(cameras))]
    known = [kept.get(name, () if pictures is None else _files(pictures / name)) for name in names]
    done = sum(record is not None for record in known)
    views = []
    # Minutes each for large models.
    with tqdm(total=4 * len(cameras), initial=4 * done, unit="score", disable=not progress) as bar:
        for index, (name, camera, record) in enumerate(zip(names, cameras, known, strict=True)):
            if record is not None:
                views.append(CameraScores(**record))
                continue
            view = View(name, camera, nothing.expand(3, camera.height, camera.width))
            out = model.rendering(model.test_opacities, view)
            variance, covered = color_variance_map(out.splats)
            bar.update()
            results = []
            for method in (score, exact, neutral):
                results.append(method(opacities, view, index=index))
                bar.update()
            views.append(
                CameraScores(
                    name=name,
                    ca=results[0].value,
                    ca_std_error=results[0].std_error,
                    ca_exact=results[1].value,
                    ca_neutral=results[2].value,
                    cv=variance[covered].double().mean().item() if bool(covered.any()) else math.nan,
                    visible=results[0].visible.double().mean().item(),
                    covered=out.alpha.double().mean().item(),
                    ca_reason=str(results[0].reason),
                )
            )
            if pictures is not None:
                _draw(out.image.clamp(0, 1), results, pictures / name)
            kept.add(name, asdict(views[-1]))
    return CameraEvaluation(views)


def _files(stem: Path) -> tuple[Path, Path]:
    """Return the places of the render and of the panel of a camera."""
    return stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}{PANEL}.png")


def _draw(image: Tensor, results: Sequence[CAResult], stem: Path) -> None:
    """Write the render, and a panel of it with the variance of the protocol, the exact one and the neutral one."""
    maps = [heat_map(r.variance.masked_fill(~r.visible, math.nan).float(), CA_PICTURE_RANGE) for r in results]
    titles = [f"{name} {r.value * 1e3:.2f}e-3" for name, r in zip(("CA", "exact", "neutral"), results, strict=True)]
    render, panel = _files(stem)
    save_png(render, image)
    save_png(panel, side_by_side([image, *maps], [f"render {stem.name}", *titles]))
