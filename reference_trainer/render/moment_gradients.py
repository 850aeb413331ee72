"""The gradients of exact moments, a block of tile lists at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from reference_trainer.render.footprints import PIXELS, monomials
from reference_trainer.render.recursion import Entries, Terms, contrasts, evaluate_terms, in_front, parts
from reference_trainer.render.workspace import Workspace

__all__ = ["block_gradients"]


def block_gradients(
    entries: Entries,
    images: tuple[Tensor, Tensor, Tensor],
    to_entries: Tensor,
    workspaces: tuple[Workspace, Workspace],
    *,
    pairs: int,
    factors: bool,
) -> None:
    """Carry the gradients of a block's means and variances back to its entries, in parts of bounded size.

    Args:
        entries: of the block.
        images: what is behind all splats, the gradient of the means (becomes that of what is behind all splats), and
            the gradient of the variances, each of shape (C, 64, T).
        to_entries: receives the gradient of the sums of ln alpha times each monomial, of the values, and of m and v,
            shape (6 + C + 2, L, T).
        workspaces: ten buffers for pixel-Gaussian pairs, and one for pairs times channels.
        pairs: pixel-Gaussian pairs to hold at once.
        factors: whether the gradients of m and v are needed.
    """
    mean, to_mean, to_variance = images
    longest, (channels, _, tiles) = entries.coefficients.shape[0], mean.shape
    cuts = parts(longest, max(1, pairs // (PIXELS * tiles)))

    def terms_of(first: int, last: int) -> tuple[Terms, list[Tensor], Tensor]:
        buffers = workspaces[0].of(last - first, PIXELS, tiles)
        (kept,) = workspaces[1].of(last - first, channels, PIXELS, tiles)
        return evaluate_terms(entries.part(first, last), buffers[:5]), buffers[5:], kept

    # What is behind a part, its mean and `hidden` of `_contrasts`, is all that it must know of the parts behind it.
    hidden = mean.new_zeros(PIXELS, tiles)
    behind = [(mean, hidden)]
    for first, last in reversed(cuts[1:]):
        terms, buffers, kept = terms_of(first, last)
        mean = mean.clone()
        hidden = _contrasts(terms, mean, to_variance, hidden, kept.unbind(0), buffers)
        behind.append((mean, hidden))
    front: Tensor | float = 1.0
    for (first, last), (mean, hidden) in zip(cuts, reversed(behind), strict=True):
        terms, buffers, kept = terms_of(first, last)
        _contrasts(terms, mean, to_variance, hidden, kept.unbind(0), buffers)
        part = to_entries[:, first:last]
        front = _backward(terms, (to_mean, to_variance), front, part, kept, buffers, factors=factors)


def _contrasts(
    terms: Terms,
    mean: Tensor,
    to_variance: Tensor,
    hidden: Tensor,
    contrast_rows: Sequence[Tensor],
    buffers: Sequence[Tensor],
) -> Tensor:
    """Walk back to front through a part of a block, and note what its gradients need.

    With Q_i the gradient of the weight S_i spread_i of splat i, what is behind it sums up to
    hidden_i = sum_{j > i} Q_j spread_j S_j / S_{i + 1}: walked back to front, as division would fail at 0.

    Args:
        terms: of the part.
        mean: what is behind it, shape (C, 64, T); becomes the mean in front of it.
        to_variance: gradient of the variances, shape (C, 64, T).
        hidden: of its last splat, shape (64, T).
        contrast_rows: receive the contrasts, (C, 64, T) each.
        buffers: the first two, of shape (L, 64, T), receive Q and ``hidden`` of every splat.

    Returns:
        What ``hidden`` is for the splat in front of the part, shape (64, T).
    """
    weight_rows, hidden_rows = (buffer.unbind(0) for buffer in buffers[:2])
    weighted = torch.empty_like(mean)
    hidden_rows[-1].copy_(hidden)
    beyond = torch.empty_like(hidden)
    ahead = (beyond, *hidden_rows[:-1])
    spread, shrink = terms.spread.unbind(0), terms.shrink.unbind(0)
    for i in contrasts(terms, mean, contrast_rows):
        torch.mul(to_variance, contrast_rows[i], out=weighted).mul_(contrast_rows[i])
        torch.sum(weighted, 0, out=weight_rows[i])
        torch.mul(hidden_rows[i], shrink[i], out=ahead[i]).addcmul_(weight_rows[i], spread[i])
    return beyond


def _backward(
    terms: Terms,
    gradients: tuple[Tensor, Tensor],
    first: Tensor | float,
    to_entries: Tensor,
    kept: Tensor,
    buffers: Sequence[Tensor],
    *,
    factors: bool,
) -> Tensor:
    """Carry the gradients of means and variances (C, 64, T) back to the entries of a part of a block.

    Args:
        terms: of the part.
        gradients: that of the means in front of the part (becomes that of the means behind it) and of the variances.
        first: the product of ``shrink`` in front of the part, shape (64, T), or 1.
        to_entries: receives the result, see `block_gradients`, shape (6 + C + 2, L, T).
        kept: the contrasts, shape (L, C, 64, T).
        buffers: five of shape (L, 64, T); the first two as left by `_contrasts`.
        factors: whether the gradients of m and v are needed.

    Returns:
        The product of ``shrink`` in front of the next part, shape (64, T).
    """
    to_mean, to_variance = gradients
    longest = terms.alpha.shape[0]
    to_weight, hidden, front, doubled, to_expected = buffers
    torch.mul(in_front(terms, front, first), terms.spread, out=doubled).mul_(2.0)
    following = front[-1] * terms.shrink[-1]
    to_values = to_mean.new_empty(longest, to_mean.shape[0], to_mean.shape[2])
    through, weighted = torch.empty_like(to_mean), torch.empty_like(to_mean)
    each = (kept, terms.expected, doubled, to_expected, to_values)
    rows = zip(*(x.unbind(0) for x in each), strict=True)
    for contrast, expected, twice, to_row, to_value in rows:
        torch.mul(to_mean, contrast, out=weighted)
        torch.sum(weighted, 0, out=to_row)
        torch.mul(to_variance, contrast, out=weighted)
        torch.mul(to_mean, expected, out=through).addcmul_(weighted, twice)
        torch.sum(through, 1, out=to_value)
        to_mean.sub_(through)
    # expected = m alpha, spread = v alpha^2, shrink = (1 - expected)^2 + spread
    to_shrink = hidden.mul_(front)
    to_spread = to_weight.mul_(front).add_(to_shrink)
    to_expected.addcmul_(to_shrink, 1.0 - terms.expected, value=-2.0)
    if factors:
        to_entries[-2] = (to_expected * terms.alpha).sum(1)
        to_entries[-1] = (to_spread * terms.alpha.square()).sum(1)
    along = to_spread.mul_(terms.alpha).mul_(2.0 * terms.v).addcmul_(to_expected, terms.m).mul_(terms.raw)
    pixels = monomials(along.dtype, along.device).T.expand(longest, 6, PIXELS)
    to_entries[:6] = torch.bmm(pixels, along).transpose(0, 1)
    to_entries[6:-2] = to_values.permute(1, 0, 2)
    return following
