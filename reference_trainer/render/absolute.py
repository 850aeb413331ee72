"""What AbsGS sums over the pixels for every Gaussian: blend weights, and absolute gradients of its position."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from reference_trainer.render.eager.formulas import blend_weights, over
from reference_trainer.render.eager.walk import Block, blocks, geometry_rows, pad_entries, pixel_offsets, tile
from reference_trainer.render.renderer import draw
from reference_trainer.render.splats import Rendering, Splats

__all__ = ["absgrad_sink", "absolute_gradients", "splat_weights", "with_absolute_gradients"]


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


def absolute_gradients(
    splats: Splats, values: Tensor, gradient: Tensor, background: Tensor, tiles: Iterable[Block] | None = None
) -> Tensor:
    """Sum the absolute values of the gradients that the pixels give to a splat's position (AbsGS), shape (M, 2).

    The values (M, C) of the splats were drawn over the background (C,); ``gradient`` (C + 1, H, W) is that of the loss
    with respect to their picture and the accumulated alpha; ``tiles`` are the blocks of their lists, if they are known.
    The sums are loss per pixel of displacement in x and y.
    """
    rows = pad_entries(torch.cat([geometry_rows(splats), values.T]))
    upstream = tile(gradient, splats.lists)
    behind = background.to(gradient)[:, None]
    sums = rows.new_zeros(2, rows.shape[1])
    pixels = pixel_offsets(rows)
    for block in blocks(splats.lists, rows.device) if tiles is None else tiles:
        entries = rows[:, block.gaussians]
        raw = block.alphas(entries[:6]).requires_grad_()
        with torch.enable_grad():
            drawn = over(blend_weights(raw), entries[6:], behind)
        (to_raw,) = torch.autograd.grad(drawn, raw, upstream[block.tiles])
        # ln alpha falls by half the square of (l11 dx + l21 dy, l22 dy); its gradient in the position is that of alpha
        # divided by alpha.
        x, y, l11, l21, l22 = entries[:5, :, None]
        dx, dy = pixels[0] + block.centers[0][..., None] - x, pixels[1] + block.centers[1][..., None] - y
        w1, w2 = l11 * dx + l21 * dy, l22 * dy
        slopes = raw.detach() * to_raw * torch.stack([l11 * w1, l21 * w1 + l22 * w2])
        sums.index_add_(1, block.gaussians.flatten(), slopes.abs().sum(2).flatten(1))
    return sums[:, :-1].T


class _AbsoluteGradients(torch.autograd.Function):
    """The picture unchanged; on the way back the sums of absolute gradients go to an input of their own."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, sink: Tensor, *rest: Any) -> Tensor:
        ctx.rest = (*rest, list(blocks(rest[0].lists, drawn.device)))  # now: the backward pass is to wait for nothing
        return drawn.view_as(drawn)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        splats, values, background, tiles = ctx.rest
        return gradients[0], absolute_gradients(splats, values, gradients[0], background, tiles), None, None, None


def absgrad_sink(means: Tensor) -> Tensor:
    """Return zeros of the shape of ``means``, whose gradient becomes ``means.absgrad``, as gsplat calls it."""
    sink = torch.zeros_like(means).requires_grad_()
    sink.register_hook(lambda gradient: setattr(means, "absgrad", gradient))  # type: ignore[no-untyped-call]
    return sink


def with_absolute_gradients(rendering: Rendering, sink: Tensor, background: Tensor | None = None) -> Rendering:
    """Return the rendering, whose backward pass also delivers `absolute_gradients`: as the gradient of ``sink`` (M, 2).

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
