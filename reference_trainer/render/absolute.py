"""The sums over pixels that AbsGS takes for every Gaussian: blend weights, and absolute gradients of its center."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from reference_trainer.render.renderer import rasterize
from reference_trainer.render.splats import Rendering, Splats

__all__ = ["absgrad_sink", "splat_weights", "with_absolute_gradients"]


def splat_weights(splats: Splats) -> Tensor:
    """Sum every splat's blend weight, alpha times transmittance, over the pixels of the picture; shape (M,)."""
    colors = torch.zeros_like(splats.colors).requires_grad_()
    with torch.enable_grad():
        red = rasterize(splats._replace(colors=colors)).image[0].sum()
    return torch.autograd.grad(red, colors)[0][:, 0]


class _AbsoluteGradients(torch.autograd.Function):
    """The identity, whose backward pass also hands the sums of absolute gradients to a separate input."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, sink: Tensor, splats: Splats, background: Tensor) -> Tensor:
        ctx.splats, ctx.background = splats, torch.nn.functional.pad(background, (0, 1))[:, None, None]
        ctx.save_for_backward(drawn)
        return drawn.view_as(drawn)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        # The remaining light, 1 - alpha, shows the background; once that is taken out, its gradient is part of alpha's.
        (drawn,), (gradient,) = ctx.saved_tensors, gradients
        black = torch.cat([drawn[:4] - (1 - drawn[4]) * ctx.background, drawn[4:]])
        of_alpha = gradient[4:] - (gradient[:4] * ctx.background).sum(0, keepdim=True)
        sums = ctx.splats.engine.absolute_gradients(ctx.splats, black, torch.cat([gradient[:4], of_alpha]))
        return gradient, sums, None, None


def absgrad_sink(means: Tensor) -> Tensor:
    """Return zeros shaped like ``means`` whose gradient becomes ``means.absgrad``, gsplat's name for it."""
    sink = torch.zeros_like(means).requires_grad_()
    sink.register_hook(lambda gradient: setattr(means, "absgrad", gradient))  # type: ignore[no-untyped-call]
    return sink


def with_absolute_gradients(rendering: Rendering, sink: Tensor, background: Tensor | None = None) -> Rendering:
    """Return the rendering with a backward pass that also computes `Engine.absolute_gradients`.

    They become the gradient of ``sink`` (M, 2), whose values do not matter. The image's background (3,) is black by
    default.
    """
    depth = torch.zeros_like(rendering.alpha) if rendering.depth is None else rendering.depth
    background = rendering.image.new_zeros(3) if background is None else background.detach().to(rendering.image)
    drawn = torch.cat([rendering.image, depth[None], rendering.alpha[None]])
    drawn = _AbsoluteGradients.apply(drawn, sink, rendering.splats, background)  # type: ignore[no-untyped-call]
    return rendering._replace(image=drawn[:3], alpha=drawn[4], depth=None if rendering.depth is None else drawn[3])
