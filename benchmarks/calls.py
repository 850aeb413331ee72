"""What is timed, and by which clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from time import process_time

import torch
from torch import Tensor

from benchmarks.workloads import Workload
from reference_trainer.camera import Camera
from reference_trainer.render import render
from reference_trainer.render.engine import engines_on, using_engine
from reference_trainer.renderers.gsplat import load_gsplat_render
from reference_trainer.studies.stability.quantities import render_simply
from reference_trainer.studies.study import Clock, now

__all__ = ["BASELINE", "PASSES", "Render", "gradients", "image", "others_on", "processor_clock", "render_with"]

PASSES = ("forward", "forward+backward")

Render = Callable[[Mapping[str, Tensor], Camera], Tensor]
"""From the five tensors of the Gaussians and a camera to an image (3, H, W)."""


def render_with(engine: str) -> Render:
    """Return one of the engines of the renderer as something to time."""

    def rendered(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
        with using_engine(engine):  # projection and rendering; the gradient goes through what they have chosen
            return render(**parameters, camera=camera).image

    return rendered


def _simply(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
    return render_simply(**parameters, camera=camera)


BASELINE: Render = _simply
"""The frozen simple renderer."""


def others_on(device: torch.device) -> dict[str, Render]:
    """Return what is timed beside the baseline: the engines, and gsplat where it and a CUDA device exist.

    Example:
        >>> list(others_on(torch.device("cpu")))
        ['numba', 'torch']
    """
    found = {engine: render_with(engine) for engine in engines_on(device)}
    try:
        gsplat = load_gsplat_render(device)
    except (ImportError, RuntimeError):
        return found
    return {**found, "gsplat": lambda parameters, camera: gsplat(**parameters, camera=camera).image}


@torch.no_grad()
def image(render_fn: Render, workload: Workload) -> Tensor:
    """Render a workload without keeping anything for gradients: what "forward" times, shape (3, H, W)."""
    return render_fn(workload.parameters, workload.camera)


def gradients(render_fn: Render, workload: Workload) -> dict[str, Tensor]:
    """Return the gradients of the mean squared error to the target: what "forward+backward" times.

    Example:
        >>> from benchmarks.workloads import WorkloadSpec
        >>> sorted(gradients(render_with("torch"), WorkloadSpec(20, 16, 16, 0.1).make()))
        ['colors', 'means', 'opacities', 'quaternions', 'scales']
    """
    leaves = {name: x.detach().requires_grad_() for name, x in workload.parameters.items()}
    loss = (render_fn(leaves, workload.camera) - workload.target).square().mean()
    return dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))


def processor_clock(device: torch.device) -> Clock:
    """Return a clock less disturbed by other programs: CPU time of this process; on a GPU, `now`."""
    return process_time if device.type == "cpu" else partial(now, device)
