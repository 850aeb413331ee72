"""The recursion behind exact moments, for all pixels of a block of tile lists at once.

Back to front, with ``d_i = c_i - mu_{i+1}`` the contrast of a splat with the mean of what is behind it:

    mu_i = mu_{i+1} + m alpha_i d_i        V = sum_i spread_i S_i d_i^2        S_i = prod_{j<i} shrink_j

where ``spread = v alpha^2`` and ``shrink = (1 - m alpha)^2 + spread`` (`ca_reg.functional.pixel_moments`). Every term
of V is a square times a non-negative weight: nothing cancels. A step handles one splat of each of many tiles, so the
splats are the outermost axis here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA
from reference_trainer.render.footprints import PIXELS, Footprints, block_size, footprints, monomials, tile
from reference_trainer.render.renderer import Splats
from reference_trainer.render.tiles import Block, TileLists

__all__ = ["Terms", "behind_tiles", "contrasts", "evaluate_terms", "in_front", "moment_block_size", "moments_per_splat"]

_CPU_BLOCKS = 8  # blocks so many times larger than in compositing: a step needs many pixels to be worth its call


def moment_block_size(device: torch.device) -> int:
    """Return how many pixel-Gaussian pairs to hold at once on a device."""
    return block_size(device) * (_CPU_BLOCKS if device.type == "cpu" else 1)


def behind_tiles(background: Tensor | None, splats: Splats) -> Tensor:
    """Return the colours behind the last splat per tile, (tiles, 3, 64).

    Args:
        background: one colour, (3,), one for each pixel, (3, H, W), or None for black.
        splats: of the view.

    Raises:
        ValueError: if the background has another shape.
    """
    shape = (3, splats.lists.height, splats.lists.width)
    if background is None:
        background = splats.colors.new_zeros(3)
    if background.shape not in (shape, shape[:1]):
        raise ValueError(f"background must have shape (3,) or {shape}, got {tuple(background.shape)}.")
    image = (background if background.ndim == 3 else background[:, None, None]).to(splats.colors).expand(shape)
    return tile(image, splats.lists)


def moments_per_splat(multiplier: Multiplier, splats: Splats) -> Tensor:
    """Return mean and variance of the factor of every projected Gaussian and of the absent one, shape (2, M + 1)."""
    rows = [
        x[splats.indices].to(splats.opacities) if isinstance(x, Tensor) else torch.full_like(splats.opacities, x)
        for x in (multiplier.mean, multiplier.variance)
    ]
    return torch.nn.functional.pad(torch.stack(rows), (0, 1))


class Terms(NamedTuple):
    """What a block's recursion needs, (L, T, 64) each; ``values`` is (L, C, T, 1), ``m`` and ``v`` are (L, T, 1)."""

    raw: Tensor
    alpha: Tensor
    m: Tensor
    v: Tensor
    expected: Tensor
    spread: Tensor
    shrink: Tensor
    values: Tensor


def evaluate_terms(
    table: Tensor, values: Tensor, factors: Tensor, block: Block, lists: TileLists
) -> tuple[Terms, Footprints]:
    """Evaluate the alphas of a block and the weights of the recursion."""
    splats = footprints(table, block, lists)
    tiles, longest = block.gaussians.shape
    polynomial = splats.polynomial.permute(2, 0, 1).reshape(-1, 6)
    raw = torch.mm(polynomial, monomials(table.dtype, table.device).T).exp2_().view(longest, tiles, PIXELS)
    torch.threshold_(raw, MIN_ALPHA, 0.0)
    alpha = raw.clamp(max=MAX_ALPHA)
    which = block.gaussians.T.flatten()
    m, v = factors.index_select(1, which).view(2, longest, tiles, 1)
    expected = m * alpha
    spread = torch.mul(alpha, alpha).mul_(v)
    shrink = (1.0 - expected).square_().add_(spread)
    colors = values.index_select(0, which).view(longest, tiles, -1, 1).transpose(1, 2)
    return Terms(raw, alpha, m, v, expected, spread, shrink, colors.contiguous()), splats


def in_front(terms: Terms) -> Tensor:
    """Return S, the product of ``shrink`` over all splats in front of each, (L, T, 64)."""
    front = torch.empty_like(terms.shrink)
    front[0] = 1.0
    rows = front.unbind(0)
    for nearer, factor, farther in zip(rows, terms.shrink.unbind(0), rows[1:], strict=False):
        torch.mul(nearer, factor, out=farther)
    return front


def contrasts(terms: Terms, mean: Tensor, buffers: Sequence[Tensor]) -> Iterator[int]:
    """Walk back to front; yield the number of each splat when its contrast with the mean behind it is in its buffer.

    Args:
        terms: of the block.
        mean: what lies behind all splats, (C, T, 64); becomes the mean of the pixel.
        buffers: one (C, T, 64) for each splat; they may be one and the same, to be read before the next step.
    """
    values, expected = terms.values.unbind(0), terms.expected.unbind(0)
    for i in reversed(range(len(values))):
        torch.sub(values[i], mean, out=buffers[i])
        yield i
        mean.addcmul_(expected[i], buffers[i])
