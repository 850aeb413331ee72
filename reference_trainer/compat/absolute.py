"""What AbsGS sums over the pixels for every Gaussian: blend weights, and absolute gradients of its position."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from reference_trainer.render import Splats
from reference_trainer.render.blending import block_alphas
from reference_trainer.render.footprints import PIXELS, block_size, footprints, monomials, pack, pad, tile
from reference_trainer.render.workspace import Workspace

__all__ = ["absolute_gradients", "splat_weights", "with_absolute_gradients"]


@torch.no_grad()
def splat_weights(splats: Splats) -> Tensor:
    """Sum every splat's blend weight, alpha times transmittance, over the pixels; shape (M,)."""
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    sums = table.new_zeros(table.shape[1])
    inside = _inside(splats)
    for chunk in splats.lists.chunks(block_size(table.device)):
        polynomial = footprints(table, chunk, splats.lists).polynomial
        of_entries = table.new_empty(1, chunk.gaussians.shape[0])
        workspace = Workspace(4, chunk, table)
        for block in chunk.blocks:
            weights = block_alphas(polynomial, block, workspace.of(block.shape[0], PIXELS, block.shape[1])).weights
            block.of(of_entries)[0] = torch.bmm(inside[chunk.tiles[block.tiles]], weights)[:, 0]
        sums.index_add_(0, chunk.gaussians, of_entries[0])
    return sums[:-1]


@torch.no_grad()
def absolute_gradients(splats: Splats, gradient: Tensor, background: Tensor) -> Tensor:
    """Sum the absolute values of the gradients that the pixels give to a splat's position (AbsGS).

    Args:
        splats: of a rendering.
        gradient: of the loss with respect to the image, shape (3, H, W).
        background: colour behind everything, shape (3,).

    Returns:
        Sums of absolute values in x and y, loss per pixel of displacement, shape (M, 2).
    """
    table = pack(splats.projection.means, splats.projection.factors, splats.opacities)
    values = pad(torch.cat([splats.colors, torch.ones_like(splats.opacities)[:, None]], dim=1))
    behind = -(gradient * background.to(gradient)[:, None, None]).sum(0, keepdim=True)
    upstream = tile(torch.cat([gradient, behind]), splats.lists)
    x, y = monomials(table.dtype, table.device)[:, 1:3, None].unbind(1)
    sums = table.new_zeros(2, table.shape[1])
    for chunk in splats.lists.chunks(block_size(table.device)):
        entries = footprints(table, chunk, splats.lists)
        of_entries = values.index_select(1, chunk.gaussians)
        geometry = torch.stack([entries.dx, entries.dy, entries.l11, entries.l21, entries.l22])
        to_entries = table.new_empty(2, chunk.gaussians.shape[0])
        workspace = Workspace(4, chunk, table)
        for block in chunk.blocks:
            alphas = block_alphas(entries.polynomial, block, workspace.of(block.shape[0], PIXELS, block.shape[1]))
            along = torch.bmm(upstream[chunk.tiles[block.tiles]].transpose(1, 2), block.of(of_entries).transpose(0, 1))
            # Loss per ln alpha: a splat adds its own value and dims by 1 / (1 - alpha) the sum of all behind it.
            behind_it = (alphas.weights * along).flip(-1).cumsum(-1).flip(-1) - alphas.weights * along
            slope = alphas.raw * (along * alphas.transmittance - behind_it / alphas.passed)
            dx, dy, l11, l21, l22 = block.of(geometry)[:, :, None]
            w1, w2 = l11 * (x - dx) + l21 * (y - dy), l22 * (y - dy)
            target = block.of(to_entries)
            target[0] = (slope * l11 * w1).abs().sum(1)
            target[1] = (slope * (l21 * w1 + l22 * w2)).abs().sum(1)
        sums.index_add_(1, chunk.gaussians, to_entries)
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


def _inside(splats: Splats) -> Tensor:
    """Return 1 for the pixels of every tile that belong to the picture, shape (tiles, 1, 64)."""
    ones = splats.colors.new_ones(1, splats.lists.height, splats.lists.width)
    return tile(ones, splats.lists)
