"""Exact moments for any renderer that can list the Gaussians it composites at each pixel.

Many code bases can: gsplat's ``rasterize_to_indices_in_range`` returns such lists, several forks keep per-pixel
buffers. With the alphas of the entries, :class:`ListMoments` is the moments callable of a :class:`~ca_reg.CAScore`, and
its :meth:`~ListMoments.shares` attribute the score to the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ca_reg._check import check_callable, check_count, check_opacity
from ca_reg.functional import Multiplier, contributions, pixel_moments
from ca_reg.types import ExactMoments

__all__ = ["ListMoments", "PixelLists"]


class PixelLists(NamedTuple):
    """What a renderer composites at every pixel of one view, as flat lists of P entries.

    Convention: the entries of one pixel are ordered by depth, the nearest first, no Gaussian twice; pixels may be
    interleaved in any order.

    Attributes:
        gaussians: index of each entry's Gaussian, int32 or int64, shape (P,).
        pixels: index of each entry's pixel, ``row * width + column``, int32 or int64, shape (P,).
        alphas: alpha of the Gaussian at the pixel, ``min(0.99, opacity * falloff)`` with the opacities that were passed
            in, in [0, 1], shape (P,).
        colors: view-dependent colors of all N Gaussians, shape (N, 3), dtype of ``alphas``.
        height: of the image, in pixels.
        width: of the image, in pixels.
        background: the model's own, shape (3,); None for black.
    """

    gaussians: Tensor
    pixels: Tensor
    alphas: Tensor
    colors: Tensor
    height: int
    width: int
    background: Tensor | None = None


class ListMoments:
    """A moments callable (:class:`~ca_reg.types.MomentsFn`) from per-pixel lists.

    The lists must be complete. Renderers stop at an opaque surface, but what lies behind it shows when splats of the
    surface are dropped, so a list that ends there misses part of the variance.

    Pixels are processed in blocks, of about 40 floats per padded entry; a backward pass retains all. Differentiable in
    everything that ``lists_fn`` is differentiable in, and in the multiplier.

    Args:
        lists_fn: ``lists_fn(opacity, view)`` returns the :class:`PixelLists` of the view for these activated
            opacities, (N,) or (N, 1) as the caller gave them.
        elements: largest number of padded entries in a block; a longer list is a block of its own.

    Example:
        Two Gaussians and two pixels; the second pixel sees the first Gaussian only.

        >>> def lists_fn(opacity: Tensor, view: None) -> PixelLists:
        ...     gaussians = torch.tensor([1, 0, 0])      # what the rasterizer lists: which Gaussian,
        ...     pixels = torch.tensor([0, 0, 1])         # at which pixel, nearest first in each,
        ...     falloff = torch.tensor([1.0, 1.0, 0.6])  # and exp(-power) of this Gaussian there
        ...     alphas = (opacity.flatten()[gaussians] * falloff).clamp(max=0.99)
        ...     colors = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
        ...     return PixelLists(gaussians, pixels, alphas, colors, height=1, width=2)
        >>> from ca_reg import CAScore, attribute
        >>> moments = ListMoments(lists_fn)
        >>> score = CAScore.exact(moments, threshold=0.2)
        >>> opacity = torch.full((2,), 0.8)
        >>> score(opacity, None).variance
        tensor([[0.1195, 0.0576]], dtype=torch.float64)
        >>> attribute(score, moments.shares, opacity, None).shares
        tensor([0.0704, 0.0181], dtype=torch.float64)
    """

    def __init__(self, lists_fn: Callable[[Tensor, Any], PixelLists], *, elements: int = 1 << 20) -> None:
        check_callable(lists_fn, "lists_fn")
        check_count(elements, "elements", minimum=1)
        self.lists_fn = lists_fn
        self.elements = int(elements)

    def __call__(self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None) -> ExactMoments:
        """Return the exact moments of a view: mean and variance (3, H, W) and the expected alpha (H, W).

        The multiplier is numbers or tensors of one value per Gaussian, the background (3,) or (3, H, W), or None for
        that of the lists.

        Raises:
            TypeError: if ``lists_fn`` returns no :class:`PixelLists`, or a dtype does not fit.
            ValueError: if a shape does not fit, an index is out of range, or an alpha outside [0, 1].
        """
        lists = self._lists(opacity, view)
        pixels, means, variances = [], [], []
        for block in _blocks(lists, multiplier, background, self.elements):
            mean, variance = pixel_moments(block.alphas, block.values, block.multiplier, background=block.background)
            pixels.append(block.pixels)
            means.append(mean)
            variances.append(variance)
        place = torch.cat(pixels).argsort()
        size = (4, lists.height, lists.width)
        mean, variance = (torch.cat(x)[place].T.reshape(size) for x in (means, variances))
        return ExactMoments(mean[:3], variance[:3], mean[3])

    def shares(
        self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None, weights: Tensor
    ) -> Tensor:
        """Return what each Gaussian contributes to a weighted sum of the variance map, shape (N,), float64.

        It is as described at :class:`~ca_reg.attribution.SharesFn`; the shares add up to the weighted sum.

        Example:
            >>> def lists_fn(opacity: Tensor, view: None) -> PixelLists:
            ...     one = torch.tensor([0])
            ...     return PixelLists(one, one, opacity[one], torch.ones(2, 3), height=1, width=1)
            >>> ones = torch.ones(1, 1)
            >>> ListMoments(lists_fn).shares(torch.tensor([0.5, 0.5]), None, Multiplier.dropout(0.5), None, ones)
            tensor([0.0625, 0.0000], dtype=torch.float64)
        """
        lists = self._lists(opacity, view)
        if weights.shape != (lists.height, lists.width):
            raise ValueError(
                f"weights must have the shape of the image, {(lists.height, lists.width)}, got {tuple(weights.shape)}."
            )
        flat = weights.to(lists.alphas.device, torch.float64).flatten()
        out = flat.new_zeros(lists.colors.shape[0] + 1)  # the last one gathers the padding
        for block in _blocks(lists, multiplier, background, self.elements):
            parts = contributions(block.alphas, block.values, block.multiplier, background=block.background)
            parts = parts[..., :3].mean(-1, dtype=torch.float64) * flat[block.pixels, None]
            out = out.index_add(0, block.gaussians.flatten(), parts.flatten())
        return out[:-1]

    def _lists(self, opacity: Tensor, view: Any) -> PixelLists:
        """Ask for the lists and check them."""
        check_opacity(opacity)
        lists = self.lists_fn(opacity, view)
        if not isinstance(lists, PixelLists):
            raise TypeError(f"lists_fn must return ca_reg.lists.PixelLists, got {type(lists).__name__}.")
        check_count(lists.height, "height", minimum=1)
        check_count(lists.width, "width", minimum=1)
        n = opacity.shape[0]
        if lists.colors.shape != (n, 3):
            raise ValueError(
                f"colors of the lists must have shape {(n, 3)}, one for each opacity, got {tuple(lists.colors.shape)}; "
                "give those of all Gaussians, not only of the listed ones."
            )
        if lists.alphas.ndim != 1:
            raise ValueError(f"alphas of the lists must have shape (P,), got {tuple(lists.alphas.shape)}.")
        _check_indices(lists.gaussians, "gaussians", lists, n)
        _check_indices(lists.pixels, "pixels", lists, lists.height * lists.width)
        return lists


class _Block(NamedTuple):
    """B pixels with lists padded to L entries; in the padding alpha is 0 and the Gaussian index is N."""

    pixels: Tensor
    gaussians: Tensor
    alphas: Tensor
    values: Tensor
    multiplier: Multiplier
    background: Tensor


def _blocks(lists: PixelLists, multiplier: Multiplier, background: Tensor | None, elements: int) -> Iterator[_Block]:
    """Yield all pixels in blocks, longest lists first; the fourth channel, 1 for every splat, gives the alpha."""
    n, size = lists.colors.shape[0], lists.height * lists.width
    pixels = lists.pixels.long()
    order = pixels.argsort(stable=True)
    # Entry P, one behind the last, is the padding: Gaussian n, of alpha 0.
    gaussians = torch.nn.functional.pad(lists.gaussians.long()[order], (0, 1), value=n)
    alphas = torch.nn.functional.pad(lists.alphas[order], (0, 1))
    values = torch.cat([lists.colors, torch.ones_like(lists.colors[:, :1])], dim=1)
    values = torch.nn.functional.pad(values, (0, 0, 0, 1))
    background = torch.nn.functional.pad(_background_of(lists, background), (0, 1))
    mean, variance = (_per_gaussian(getattr(multiplier, name), name, lists) for name in ("mean", "variance"))

    counts = pixels.bincount(minlength=size)
    first = counts.cumsum(0) - counts
    by_length = counts.argsort(descending=True)
    lengths = counts[by_length].clamp(min=1)
    start = 0
    while start < size:
        longest = int(lengths[start])
        # Lists up to half the longest wait for a later block, so at most half of a block is padding.
        similar = int((lengths > longest // 2).sum())
        stop = min(start + max(1, elements // longest), similar)
        which = by_length[start:stop]
        column = torch.arange(longest, device=which.device)
        entry = torch.where(column < counts[which, None], first[which, None] + column, pixels.shape[0])
        listed = gaussians[entry]
        yield _Block(
            pixels=which,
            gaussians=listed,
            alphas=alphas.index_select(0, entry.flatten()).view(entry.shape),
            values=values.index_select(0, listed.flatten()).view(*entry.shape, 4),
            multiplier=Multiplier(_gather(mean, listed), _gather(variance, listed)),
            background=background[which],
        )
        start = stop


def _background_of(lists: PixelLists, background: Tensor | None) -> Tensor:
    """Return the color behind every pixel, shape (H * W, 3)."""
    if background is None:
        background = lists.colors.new_zeros(3) if lists.background is None else lists.background
    shape = (3, lists.height, lists.width)
    if background.shape not in (shape, shape[:1]):
        raise ValueError(
            f"background must have shape (3,) or {shape}, got {tuple(background.shape)}; images are channels first, "
            "layout 'CHW' of a score."
        )
    background = background.to(lists.colors)
    return (background if background.ndim == 3 else background[:, None, None]).expand(shape).flatten(1).T


def _per_gaussian(moment: float | Tensor, name: str, lists: PixelLists) -> float | Tensor:
    """Return a moment of the multiplier as it is if a number, else one value per Gaussian and one for the padding."""
    if not isinstance(moment, Tensor):
        return moment
    n = lists.colors.shape[0]
    if moment.shape not in ((n,), (n, 1)):
        raise ValueError(
            f"the {name} of the multiplier must be a number or have shape ({n},) or ({n}, 1), one value per Gaussian, "
            f"got {tuple(moment.shape)}."
        )
    return torch.nn.functional.pad(moment.to(lists.alphas).flatten(), (0, 1))


def _gather(moment: float | Tensor, listed: Tensor) -> float | Tensor:
    """Return a moment for every entry of a block."""
    if not isinstance(moment, Tensor):
        return moment
    return moment.index_select(0, listed.flatten()).view(listed.shape)


def _check_indices(indices: Tensor, name: str, lists: PixelLists, end: int) -> None:
    """Raise unless there is one index in [0, end) for every alpha."""
    if indices.dtype not in (torch.int32, torch.int64):
        raise TypeError(f"{name} of the lists must be int64 or int32 indices, got {indices.dtype}.")
    if indices.shape != lists.alphas.shape:
        raise ValueError(
            f"{name} of the lists must have the shape of alphas, {tuple(lists.alphas.shape)}, got "
            f"{tuple(indices.shape)}."
        )
    if indices.numel() == 0:
        return
    low, high = (int(x) for x in torch.aminmax(indices))
    if low < 0 or high >= end:
        raise ValueError(f"{name} of the lists must be in [0, {end}), got values from {low} to {high}.")
