"""What hangs between the cameras: the PSNR of a run without the Gaussians in front of a test view.

``python -m benchmarks.in_front RUN --view 000024 --nearer 450``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.tables import markdown_table, mean_std
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.scene import View

__all__ = ["in_front", "main"]


def main(run: Annotated[Path, tyro.conf.Positional], view: str, nearer: float) -> None:
    """Print the mean PSNR of training and test views, with and without the Gaussians in front of a test view.

    Args:
        run: folder of a run whose test-time opacities do not depend on the camera.
        view: name of the test view, without extension.
        nearer: depth up to which Gaussians are left out, world units.
    """
    model, scene = load_run_model(run)
    front = in_front(model, next(each for each in scene.test if Path(each.name).stem == view), nearer)
    opacities = model.test_opacities
    chosen = {"all": opacities, "without those in front": opacities.masked_fill(front, 0.0)}
    rows = [
        {"Gaussians": name, "train PSNR": _mean_psnr(model, kept, scene.train)}
        | {"test PSNR": _mean_psnr(model, kept, scene.test)}
        for name, kept in chosen.items()
    ]
    print(f"{int(front.sum())} of {len(front)} are in front.\n\n" + markdown_table(rows, list(rows[0])), end="")


def in_front(model: TrainedModel, view: View, nearer: float) -> Tensor:
    """Return which Gaussians have their center between the plane of the camera and a depth, (N,) bool."""
    _, depths = view.camera.project(model.gaussians.means.detach())
    return (depths > 0) & (depths < nearer)


@torch.no_grad()
def _mean_psnr(model: TrainedModel, opacities: Tensor, views: tuple[View, ...]) -> float:
    return mean_std(psnr(model.render(opacities, x)[0].clamp(0, 1), x.image, x.mask) for x in views)[0]


if __name__ == "__main__":
    tyro.cli(main)
