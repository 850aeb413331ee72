"""What AbsGS sums over the pixels for every Gaussian: blend weights, and absolute gradients of its position."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from reference_trainer.render.renderer import draw
from reference_trainer.render.splats import Rendering, Splats

__all__ = ["absgrad_sink", "splat_weights", "with_absolute_gradients"]


def splat_weights(splats: Splats) -> Tensor:
    """Sum every splat's blend weight, alpha times transmittance, over the pixels of the picture; shape (M,)."""
    colors = torch.zeros_like(splats.colors).requires_grad_()
    with torch.enable_grad():
        red = draw(_detached(splats)._replace(colors=colors)).image[0].sum()
    return torch.autograd.grad(red, colors)[0][:, 0]


def _detached(splats: Splats) -> Splats:
    return splats._replace(
        projection=type(splats.projection)(*(x.detach() for x in splats.projection)),
        opacities=splats.opacities.detach(),
        colors=splats.colors.detach(),
    )


class _AbsoluteGradients(torch.autograd.Function):
    """The picture unchanged; on the way back the sums of absolute gradients go to an input of their own."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, sink: Tensor, *rest: Any) -> Tensor:
        splats, values, background = rest
        ctx.sums = splats.engine.absolute_gradients(splats, values, background, drawn)
        return drawn.view_as(drawn)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return gradients[0], ctx.sums(gradients[0]), None, None, None


def absgrad_sink(means: Tensor) -> Tensor:
    """Return zeros of the shape of ``means``, whose gradient becomes ``means.absgrad``, as gsplat calls it."""
    sink = torch.zeros_like(means).requires_grad_()
    sink.register_hook(lambda gradient: setattr(means, "absgrad", gradient))  # type: ignore[no-untyped-call]
    return sink


def with_absolute_gradients(rendering: Rendering, sink: Tensor, background: Tensor | None = None) -> Rendering:
    """Return the rendering, whose backward pass also delivers `Engine.absolute_gradients`.

    They become the gradient of ``sink`` (M, 2).
    The values of the sink do not matter. The background (3,) of the image is black by default.
    """
    splats, shown = _detached(rendering.splats), rendering.depth
    values = torch.cat([splats.colors, splats.projection.depths[:, None]], 1)
    behind = values.new_zeros(4)
    if background is not None:
        behind[:3] = background.detach()
    depth = torch.zeros_like(rendering.alpha) if shown is None else shown
    drawn = torch.cat([rendering.image, depth[None], rendering.alpha[None]])
    drawn = _AbsoluteGradients.apply(drawn, sink, splats, values, behind)  # type: ignore[no-untyped-call]
    return rendering._replace(image=drawn[:3], alpha=drawn[4], depth=None if shown is None else drawn[3])
