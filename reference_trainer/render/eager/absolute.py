"""The sums of absolute gradients of AbsGS."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from reference_trainer.render.eager.formulas import blend_weights, over
from reference_trainer.render.eager.walk import Block, blocks, geometry_rows, pad_entries, pixel_offsets, tile
from reference_trainer.render.splats import Splats

__all__ = ["absolute_gradients"]


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
