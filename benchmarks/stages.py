"""Where the time of a rendering goes: stage by stage, of whichever engine renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor

from benchmarks.workloads import Workload
from reference_trainer.render import splat
from reference_trainer.render.engine import engine_for, using_engine
from reference_trainer.studies.study import Clock

__all__ = ["STAGES", "Staged", "staged"]

STAGES = ("projection", "binning", "drawing", "loss", "drawing backward", "projection backward")


class Staged(NamedTuple):
    """A rendering and its gradients, stage by stage.

    Args:
        seconds: of every stage.
        image: shape (3, H, W).
        gradients: of the mean squared error to the target, by name of the parameter.
        entries: in the lists of all tiles.
    """

    seconds: dict[str, float]
    image: Tensor
    gradients: dict[str, Tensor]
    entries: int


def staged(workload: Workload, engine: str, clock: Clock) -> Staged:
    """Do what a gradient does, with the clock read between the stages.

    The graph is cut before drawing, so that its two sides can be differentiated on their own. Projection includes the
    checks of the inputs and the choice of the Gaussians that can be seen, which here are all of them. Spherical
    harmonics, of which the workloads have none, are not measured.

    Example:
        >>> import time
        >>> from benchmarks.workloads import WorkloadSpec
        >>> result = staged(WorkloadSpec(20, 16, 16, 0.1).make(), "torch", time.perf_counter)
        >>> tuple(result.seconds) == STAGES
        True
    """
    leaves = {name: x.detach().requires_grad_() for name, x in workload.parameters.items()}
    colors = leaves["colors"]
    binning = 0.0

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            nonlocal binning
            start = clock()
            result = function(*arguments)
            binning = clock() - start
            return result

        return call

    with (
        using_engine(engine),
        mock.patch.object(room := engine_for(colors.device, colors.dtype), "bin", timed(room.bin)),
    ):
        times = [clock()]
        splats = splat(**leaves, camera=workload.camera)
        end = clock()
        times += [end - binning, end]
    ends = (splats.projection.means, splats.projection.factors, splats.opacities, splats.colors)
    means, factors, *rest = cut = [x.detach().requires_grad_() for x in ends]
    inner = splats._replace(
        projection=splats.projection._replace(means=means, factors=factors), opacities=rest[0], colors=rest[1]
    )
    image, *_ = inner.engine.composite(inner, colors.new_zeros(3), depth=False)
    times.append(clock())
    drawn = image.detach().requires_grad_()
    (to_image,) = torch.autograd.grad((drawn - workload.target).square().mean(), drawn)
    times.append(clock())
    flat = torch.autograd.grad(image, cut, to_image)
    times.append(clock())
    outer = torch.autograd.grad(ends, list(leaves.values()), flat)
    times.append(clock())
    seconds = {name: end - start for name, start, end in zip(STAGES, times[:-1], times[1:], strict=True)}
    gradients = dict(zip(leaves, outer, strict=True))
    return Staged(seconds, image.detach(), gradients, splats.lists.gaussians.shape[0])
