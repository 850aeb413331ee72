"""What AbsGS sums over the pixels for every Gaussian: blend weights, and absolute gradients of its position."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from reference_trainer.render import Splats
from reference_trainer.render.eager.formulas import blend_weights, over
from reference_trainer.render.eager.walk import blocks, geometry_rows, pad_entries, pixel_offsets, tile

__all__ = ["absolute_gradients", "splat_weights", "with_absolute_gradients"]


@torch.no_grad()
def splat_weights(splats: Splats) -> Tensor:
    """Sum every splat's blend weight, alpha times transmittance, over the pixels of the picture; shape (M,)."""
    rows = pad_entries(geometry_rows(splats))
    sums = rows.new_zeros(rows.shape[1])
    inside = tile(splats.colors.new_ones(1, splats.lists.height, splats.lists.width), splats.lists)
    for block in blocks(splats.lists, rows.device):
        weights = blend_weights(block.alphas(rows[:, block.gaussians]))
        sums.index_add_(0, block.gaussians.flatten(), (inside[block.tiles] @ weights).flatten())
    return sums[:-1]


def absolute_gradients(splats: Splats, gradient: Tensor, background: Tensor) -> Tensor:
    """Sum the absolute values of the gradients that the pixels give to a splat's position (AbsGS).

    Args:
        splats: of a rendering, without gradients.
        gradient: of the loss with respect to the image, shape (3, H, W).
        background: colour behind everything, shape (3,).

    Returns:
        Sums of absolute values in x and y, loss per pixel of displacement, shape (M, 2).
    """
    rows = pad_entries(torch.cat([geometry_rows(splats), splats.colors.T]))
    upstream = tile(gradient, splats.lists)
    behind = background.to(gradient)[:, None]
    sums = rows.new_zeros(2, rows.shape[1])
    pixels = pixel_offsets(rows)
    for block in blocks(splats.lists, rows.device):
        entries = rows[:, block.gaussians]
        raw = block.alphas(entries[:6]).requires_grad_()
        with torch.enable_grad():
            image = over(blend_weights(raw), entries[6:], behind)[:, :3]
        (to_raw,) = torch.autograd.grad(image, raw, upstream[block.tiles])
        # ln alpha falls by half the square of (l11 dx + l21 dy, l22 dy); its gradient in the position is that of alpha
        # divided by alpha.
        x, y, l11, l21, l22 = entries[:5, :, None]
        dx, dy = pixels[0] + block.centers[0][..., None] - x, pixels[1] + block.centers[1][..., None] - y
        w1, w2 = l11 * dx + l21 * dy, l22 * dy
        slopes = raw.detach() * to_raw * torch.stack([l11 * w1, l21 * w1 + l22 * w2])
        sums.index_add_(1, block.gaussians.flatten(), slopes.abs().sum(2).flatten(1))
    return sums[:, :-1].T


class _AbsoluteGradients(torch.autograd.Function):
    """The image unchanged; on the way back the sums of absolute gradients go to an input of their own."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, sink: Tensor, splats: Splats, background: Tensor) -> Tensor:
        ctx.splats, ctx.background = splats, background
        return image.view_as(image)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        return gradients[0], absolute_gradients(ctx.splats, gradients[0], ctx.background), None, None


def with_absolute_gradients(image: Tensor, sink: Tensor, splats: Splats, background: Tensor) -> Tensor:
    """Return the image, whose backward pass also delivers `absolute_gradients`.

    Args:
        image: rendered from the splats, shape (3, H, W).
        sink: receives them as its gradient; its values do not matter, shape (M, 2).
        splats: of the image.
        background: of the image, shape (3,).
    """
    detached = splats._replace(
        projection=type(splats.projection)(*(x.detach() for x in splats.projection)),
        opacities=splats.opacities.detach(),
        colors=splats.colors.detach(),
    )
    result: Tensor = _AbsoluteGradients.apply(image, sink, detached, background)  # type: ignore[no-untyped-call]
    return result
