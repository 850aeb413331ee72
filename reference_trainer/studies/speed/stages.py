"""Where the time of a rendering goes: the renderer's public stages, one after the other, each with its own clock."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.blending import composite
from reference_trainer.render.constants import TILE
from reference_trainer.render.eager.binning import bin_gaussians
from reference_trainer.render.eager.projection import project
from reference_trainer.studies.speed.workloads import Workload
from reference_trainer.studies.timing import now

__all__ = ["STAGES", "Staged", "staged"]

STAGES = ("projection", "binning and sorting", "blending", "loss", "blending backward", "projection backward")


class Staged(NamedTuple):
    """A rendering and its gradients, stage by stage.

    Args:
        seconds: of every stage.
        image: shape (3, H, W).
        gradients: of the mean squared error to the target, by name of the parameter.
        evaluated: pixel-Gaussian pairs in the tiles' lists.
    """

    seconds: dict[str, float]
    image: Tensor
    gradients: dict[str, Tensor]
    evaluated: int


def staged(workload: Workload) -> Staged:
    """Do what a gradient does, with the clock read between the stages.

    The graph is cut before blending, so that its two sides can be differentiated on their own. Left out is the choice
    of the Gaussians that can be seen, which here are all of them, and spherical harmonics, which the workloads do not
    have.

    Example:
        >>> from reference_trainer.studies.speed.workloads import WorkloadSpec
        >>> result = staged(WorkloadSpec(20, 16, 16, 0.1).make())
        >>> tuple(result.seconds) == STAGES
        True
    """
    leaves = {name: x.detach().requires_grad_() for name, x in workload.parameters.items()}
    camera, device = workload.camera, workload.means.device
    times = [now(device)]
    projection = project(leaves["means"], leaves["quaternions"], leaves["scales"], camera)
    times.append(now(device))
    with torch.no_grad():
        lists = bin_gaussians(projection, leaves["opacities"], camera.width, camera.height)
    times.append(now(device))
    means, factors = (x.detach().requires_grad_() for x in (projection.means, projection.factors))
    # The fourth sum is the accumulated alpha, which the renderer always gives.
    values = torch.cat([leaves["colors"], torch.ones_like(leaves["opacities"])[:, None]], dim=1)
    image = composite(means, factors, leaves["opacities"], values, lists)[:3]
    times.append(now(device))
    loss = (image - workload.target).square().mean()
    times.append(now(device))
    *flat, opacities, colors = torch.autograd.grad(loss, [means, factors, leaves["opacities"], leaves["colors"]])
    times.append(now(device))
    inner = {name: leaves[name] for name in ("means", "quaternions", "scales")}
    outer = torch.autograd.grad([projection.means, projection.factors], list(inner.values()), flat)
    times.append(now(device))
    gradients = dict(zip(inner, outer, strict=True)) | {"opacities": opacities, "colors": colors}
    seconds = {name: end - start for name, start, end in zip(STAGES, times[:-1], times[1:], strict=True)}
    return Staged(seconds, image.detach(), gradients, int(lists.lengths.sum()) * TILE * TILE)
