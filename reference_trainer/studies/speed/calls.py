"""What is timed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render import render
from reference_trainer.studies.stability.baseline import render_simply
from reference_trainer.studies.speed.workloads import Workload

__all__ = ["BASELINE", "SUBJECT", "Draw", "gradients", "image"]

Draw = Callable[[Mapping[str, Tensor], Camera], Tensor]
"""From the five tensors of the Gaussians and a camera to an image (3, H, W)."""


def _subject(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
    p = parameters
    return render(p["means"], p["quaternions"], p["scales"], p["opacities"], camera, colors=p["colors"]).image


def _baseline(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
    return render_simply(**parameters, camera=camera)


SUBJECT: Draw = _subject
"""The renderer of this package."""

BASELINE: Draw = _baseline
"""The frozen simple one."""


@torch.no_grad()
def image(draw: Draw, workload: Workload) -> Tensor:
    """Render a workload without keeping anything for gradients: what "forward" times, shape (3, H, W)."""
    return draw(workload.parameters, workload.camera)


def gradients(draw: Draw, workload: Workload) -> dict[str, Tensor]:
    """Return the gradients of the mean squared error to the target: what "forward+backward" times.

    Example:
        >>> from reference_trainer.studies.speed.workloads import WorkloadSpec
        >>> sorted(gradients(SUBJECT, WorkloadSpec(20, 16, 16, 0.1).make()))
        ['colors', 'means', 'opacities', 'quaternions', 'scales']
    """
    leaves = {name: x.detach().requires_grad_() for name, x in workload.parameters.items()}
    loss = (draw(leaves, workload.camera) - workload.target).square().mean()
    return dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
