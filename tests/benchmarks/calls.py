"""What is timed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from benchmarks.workloads import Workload
from reference_trainer.camera import Camera
from reference_trainer.render import render
from reference_trainer.render.engine import engines_on, using_engine
from reference_trainer.renderers.gsplat import load_gsplat_render
from reference_trainer.studies.stability.baseline import render_simply

__all__ = ["BASELINE", "PASSES", "Draw", "draw_of", "gradients", "image", "others_on"]

PASSES = ("forward", "forward+backward")

Draw = Callable[[Mapping[str, Tensor], Camera], Tensor]
"""From the five tensors of the Gaussians and a camera to an image (3, H, W)."""


def draw_of(engine: str) -> Draw:
    """Return one of the engines of the renderer as something to time."""

    def draw(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
        with using_engine(engine):  # projection and drawing; the gradient goes through what they have chosen
            return render(**parameters, camera=camera).image

    return draw


def _simply(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
    return render_simply(**parameters, camera=camera)


BASELINE: Draw = _simply
"""The frozen simple renderer."""


def others_on(device: torch.device) -> dict[str, Draw]:
    """Return what is timed beside the baseline: the engines, and gsplat where it and a CUDA device exist.

    Example:
        >>> list(others_on(torch.device("cpu")))
        ['numba', 'torch']
    """
    found = {engine: draw_of(engine) for engine in engines_on(device)}
    try:
        gsplat = load_gsplat_render(device)
    except (ImportError, RuntimeError):
        return found
    return {**found, "gsplat": lambda parameters, camera: gsplat(**parameters, camera=camera).image}


@torch.no_grad()
def image(draw: Draw, workload: Workload) -> Tensor:
    """Render a workload without keeping anything for gradients: what "forward" times, shape (3, H, W)."""
    return draw(workload.parameters, workload.camera)


def gradients(draw: Draw, workload: Workload) -> dict[str, Tensor]:
    """Return the gradients of the mean squared error to the target: what "forward+backward" times.

    Example:
        >>> from benchmarks.workloads import WorkloadSpec
        >>> sorted(gradients(draw_of("torch"), WorkloadSpec(20, 16, 16, 0.1).make()))
        ['colors', 'means', 'opacities', 'quaternions', 'scales']
    """
    leaves = {name: x.detach().requires_grad_() for name, x in workload.parameters.items()}
    loss = (draw(leaves, workload.camera) - workload.target).square().mean()
    return dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
