"""Which Gaussian touches which tile of the image, in depth order."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.splats import Projection, TileLists

__all__ = ["bin_gaussians"]


def bin_gaussians(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile, see `Engine.bin`."""
    device = opacities.device
    order = torch.argsort(projection.depths, stable=True)
    mean_x, mean_y = projection.means[order].unbind(-1)
    l11, l21, l22 = projection.factors[order].unbind(-1)
    xx, xy, yy = projection.covariances[order].unbind(-1)
    squared_radius = 2.0 * torch.log(opacities[order] / MIN_ALPHA).clamp_(min=0.0)

    reach = torch.sqrt(squared_radius * yy)
    top = torch.ceil(mean_y - reach - 0.5).clamp_(0, height)
    bottom = torch.floor(mean_y + reach - 0.5).clamp_(-1, height - 1)
    first_row = (top / TILE).long()
    rows = torch.where(bottom >= top, (bottom / TILE).floor().long() - first_row + 1, 0)
    entry, row = _expand(first_row, rows)

    y = mean_y[entry]
    upper = row * TILE + 0.5 - y
    lower = torch.clamp(row * TILE + (TILE - 0.5), max=height - 0.5) - y
    tip = (xy * torch.sqrt(squared_radius / xx))[entry]  # the dy at which the ellipse reaches furthest right
    limit, a, b, c, x = squared_radius[entry], l11[entry], l21[entry], l22[entry], mean_x[entry]

    def boundary(dy: Tensor, side: float) -> Tensor:
        half = torch.sqrt((limit - (c * dy) ** 2).clamp_(min=0.0))
        return x + (side * half - b * dy) / a

    left = boundary(torch.minimum(torch.maximum(-tip, upper), lower), -1.0)
    right = boundary(torch.minimum(torch.maximum(tip, upper), lower), 1.0)
    left = torch.ceil(left - 0.5).clamp_(0, width)
    right = torch.floor(right - 0.5).clamp_(-1, width - 1)
    first_column = (left / TILE).long()
    columns = torch.where(right >= left, (right / TILE).floor().long() - first_column + 1, 0)
    strip, column = _expand(first_column, columns)

    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tile = row[strip] * tiles_x + column
    gaussians = order[entry[strip]]
    tile, permutation = torch.sort(tile.int(), stable=True)
    touched = torch.zeros(order.shape[0], dtype=torch.bool, device=device)
    touched[gaussians] = True
    return TileLists(
        width=width,
        height=height,
        starts=torch.nn.functional.pad(torch.bincount(tile, minlength=tiles_x * tiles_y).cumsum(0), (1, 0)),
        gaussians=gaussians[permutation],
        touched=touched,
    )


def _expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """List the integers first[i] .. first[i] + counts[i] - 1 for every i; return the i and the integer of each."""
    source = torch.repeat_interleave(counts)
    offset = first - (counts.cumsum(0) - counts)
    return source, offset[source] + torch.arange(source.shape[0], device=first.device)
