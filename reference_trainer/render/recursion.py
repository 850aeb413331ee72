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
from reference_trainer.render.checks import check_background
from reference_trainer.render.constants import MAX_ALPHA, MIN_ALPHA
from reference_trainer.render.footprints import PIXELS, block_size, monomials, tile
from reference_trainer.render.renderer import Splats
from reference_trainer.render.tiles import Block, Chunk

__all__ = [
    "Entries",
    "Terms",
    "behind_tiles",
    "block_entries",
    "chunk_rows",
    "contrasts",
    "evaluate_terms",
    "in_front",
    "moment_block_size",
    "multiplier_rows",
    "parts",
]

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
        ValueError: if the background has another shape, or is not finite.
    """
    shape = (3, splats.lists.height, splats.lists.width)
    if background is None:
        background = splats.colors.new_zeros(3)
    else:
        check_background(background)
    if background.shape not in (shape, shape[:1]):
        raise ValueError(f"background must have shape (3,) or {shape}, got {tuple(background.shape)}.")
    image = (background if background.ndim == 3 else background[:, None, None]).to(splats.colors).expand(shape)
    return tile(image, splats.lists)


def multiplier_rows(multiplier: Multiplier, splats: Splats) -> Tensor:
    """Return mean and variance of the factor, (2, 1) if all Gaussians share them.

    Otherwise one column for every projected Gaussian and for the absent one, (2, M + 1).
    """
    moments = (multiplier.mean, multiplier.variance)
    if not any(isinstance(x, Tensor) for x in moments):
        return splats.opacities.new_tensor(moments)[:, None]
    rows = [
        x[splats.indices].to(splats.opacities) if isinstance(x, Tensor) else torch.full_like(splats.opacities, x)
        for x in moments
    ]
    return torch.nn.functional.pad(torch.stack(rows), (0, 1))


def chunk_rows(rows: Tensor, chunk: Chunk) -> Tensor:
    """Return rows (C, M + 1) for every entry of a chunk, (C, E); those of a shared multiplier stay (2, 1)."""
    return rows if rows.shape[1] == 1 else rows.index_select(1, chunk.gaussians)


class Terms(NamedTuple):
    """What a block's recursion needs, (L, 64, T) each; ``values`` is (L, C, 1, T), ``m`` and ``v`` (L, 1, T) or (1,).

    Tiles are the innermost axis, so that what all pixels of a tile share is broadcast along an outer one.
    """

    raw: Tensor
    alpha: Tensor
    m: Tensor
    v: Tensor
    expected: Tensor
    spread: Tensor
    shrink: Tensor
    values: Tensor


def parts(longest: int, rows: int) -> list[tuple[int, int]]:
    """Cut the entries of a block into parts of so many rows, nearest first: where each begins and ends.

    Example:
        >>> parts(7, 3)
        [(0, 3), (3, 6), (6, 7)]
    """
    return [(first, min(first + rows, longest)) for first in range(0, longest, rows)]


class Entries(NamedTuple):
    """The entries of a block, nearest first.

    Args:
        coefficients: of the log-alphas, shape (L, 6, T).
        values: what is composited, shape (L, C, 1, T).
        m: mean of the factor, shape (L, 1, T), or (1,) if all entries share it.
        v: its variance, likewise.
    """

    coefficients: Tensor
    values: Tensor
    m: Tensor
    v: Tensor

    def part(self, first: int, last: int) -> Entries:
        """Return the entries from first to last, without the last."""
        return Entries(*(x if x.ndim == 1 else x[first:last] for x in self))


def block_entries(polynomial: Tensor, values: Tensor, factors: Tensor, block: Block) -> Entries:
    """Gather the entries of a block.

    Args:
        polynomial: of the chunk's entries, shape (6, E).
        values: what is composited, shape (C, E).
        factors: mean and variance of the factor of every entry, shape (2, E), or (2, 1) if they share it.
        block: of the chunk.
    """
    m, v = factors if factors.shape[1] == 1 else block.of(factors).transpose(1, 2).contiguous()[:, :, None]
    coefficients, colors = (block.of(rows).permute(2, 0, 1).contiguous() for rows in (polynomial, values))
    return Entries(coefficients, colors[:, :, None], m, v)


def evaluate_terms(entries: Entries, buffers: Sequence[Tensor]) -> Terms:
    """Evaluate the alphas of entries and the weights of the recursion.

    Args:
        entries: of a block, or a part of them.
        buffers: five of shape (L, 64, T), which receive the result; the first two may be one if ``raw`` is not needed.
    """
    raw, alpha, expected, spread, shrink = buffers
    coefficients, values, m, v = entries
    pixels = monomials(coefficients.dtype, coefficients.device).expand(coefficients.shape[0], PIXELS, 6)
    torch.bmm(pixels, coefficients, out=raw)
    torch.threshold_(raw.exp2_(), MIN_ALPHA, 0.0)
    torch.clamp(raw, max=MAX_ALPHA, out=alpha)
    torch.mul(alpha, m, out=expected)
    torch.mul(alpha, alpha, out=spread).mul_(v)
    torch.sub(raw.new_ones(()), expected, out=shrink).square_().add_(spread)
    return Terms(raw, alpha, m, v, expected, spread, shrink, values)


def in_front(terms: Terms, front: Tensor, first: Tensor | float = 1.0) -> Tensor:
    """Put S, the product of ``shrink`` over all splats in front of each, into a buffer (L, 64, T) and return it.

    Args:
        terms: of a block, or a part of it.
        front: receives the result.
        first: S of the first splat, shape (64, T); 1 where the list begins.
    """
    front[0] = first
    rows = front.unbind(0)
    for nearer, factor, farther in zip(rows, terms.shrink.unbind(0), rows[1:], strict=False):
        torch.mul(nearer, factor, out=farther)
    return front


def contrasts(terms: Terms, mean: Tensor, buffers: Sequence[Tensor]) -> Iterator[int]:
    """Walk back to front; yield the number of each splat when its contrast with the mean behind it is in its buffer.

    Args:
        terms: of the block.
        mean: what lies behind all splats, (C, 64, T); becomes the mean of the pixel.
        buffers: one (C, 64, T) for each splat; they may be one and the same, to be read before the next step.
    """
    values, expected = terms.values.unbind(0), terms.expected.unbind(0)
    for i in reversed(range(len(values))):
        torch.sub(values[i], mean, out=buffers[i])
        yield i
        mean.addcmul_(expected[i], buffers[i])
