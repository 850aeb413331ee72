"""Exact moments for any renderer that can list the Gaussians it composites at each pixel.

Many code bases can: gsplat's ``rasterize_to_indices_in_range`` returns such lists, several forks keep per-pixel
buffers. With the alphas of the entries, :class:`ListMoments` is the moments callable of a :class:`~ca_reg.CAScore`, and
its :meth:`~ListMoments.shares` attribute the score to the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ca_reg._check import check_callable, check_count, check_opacity
from ca_reg.functional import Multiplier
from ca_reg.functional.moments import check_all_finite, check_alphas, check_types
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

    Time and memory are proportional to the number of entries: at most 28 bytes for each, besides the lists themselves.
    Differentiable in everything that ``lists_fn`` is differentiable in, and in the multiplier.

    Args:
        lists_fn: ``lists_fn(opacity, view)`` returns the :class:`PixelLists` of the view for these activated
            opacities, (N,) or (N, 1) as the caller gave them.

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

    def __init__(self, lists_fn: Callable[[Tensor, Any], PixelLists]) -> None:
        check_callable(lists_fn, "lists_fn")
        self.lists_fn = lists_fn

    def __call__(self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None) -> ExactMoments:
        """Return the exact moments of a view: mean and variance (3, H, W) and the expected alpha (H, W).

        The multiplier is numbers or tensors of one value per Gaussian, the background (3,) or (3, H, W), or None for
        that of the lists.

        Raises:
            TypeError: if ``lists_fn`` returns no :class:`PixelLists`, or a dtype does not fit.
            ValueError: if a shape does not fit, an index is out of range, or an alpha outside [0, 1].
        """
        walk = _Walk.over(*self._lists(opacity, view, background), multiplier)
        mean, variance = walk.moments()
        return ExactMoments(mean[:3], variance[:3], mean[3])

    @torch.no_grad()
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
        lists, background = self._lists(opacity, view, background)
        if weights.shape != (lists.height, lists.width):
            raise ValueError(
                f"weights must have the shape of the image, {(lists.height, lists.width)}, got {tuple(weights.shape)}."
            )
        return _Walk.over(lists, background, multiplier).shares(weights)

    @torch.no_grad()
    def color_variance(self, opacity: Tensor, view: Any) -> Tensor:
        """Return the variance of the colors blended at each pixel, :func:`ca_reg.functional.color_variance`, (H, W)."""
        walk = _Walk.over(*self._lists(opacity, view, None), Multiplier(1.0, 0.0))
        weights, pixels = walk.blend_weights()
        colors = walk.values[:, :3].index_select(0, walk.gaussians)
        nothing = torch.zeros_like(walk.background[:, :3])
        total = nothing[:, 0].index_add(0, pixels, weights).clamp_min(torch.finfo(weights.dtype).tiny)[:, None]
        mean = nothing.index_add(0, pixels, weights[:, None] * colors) / total
        spread = weights[:, None] * (colors - mean.index_select(0, pixels)).square()
        variance = (nothing.index_add(0, pixels, spread) / total).mean(1)
        return variance.index_select(0, walk.ranks).reshape(walk.shape)

    @torch.no_grad()
    def weights(self, opacity: Tensor, view: Any) -> Tensor:
        """Return every Gaussian's blend weight: alpha times transmittance, summed over the pixels, (N,), float64.

        With shares at cameras that nobody took, these tell what hangs there: :func:`ca_reg.attribution.hanging`.

        Example:
            >>> def lists_fn(opacity: Tensor, view: None) -> PixelLists:
            ...     both, one = torch.tensor([0, 1]), torch.zeros(2, dtype=torch.int64)
            ...     return PixelLists(both, one, opacity, torch.ones(2, 3), height=1, width=1)
            >>> ListMoments(lists_fn).weights(torch.tensor([0.75, 0.5]), None)  # a quarter of the light passes on
            tensor([0.7500, 0.1250], dtype=torch.float64)
        """
        walk = _Walk.over(*self._lists(opacity, view, None), Multiplier(1.0, 0.0))
        out = torch.zeros(len(walk.values), dtype=torch.float64, device=walk.values.device)
        return out.index_add_(0, walk.gaussians, walk.blend_weights()[0].double())

    def _lists(self, opacity: Tensor, view: Any, background: Tensor | None) -> tuple[PixelLists, Tensor]:
        """Ask for the lists and check them; return them and the color behind every pixel, shape (H * W, 3)."""
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
        check_types(lists.alphas, lists.colors)
        for name, indices in (("gaussians", lists.gaussians), ("pixels", lists.pixels)):
            if indices.dtype not in (torch.int32, torch.int64):
                raise TypeError(f"{name} of the lists must be int64 or int32 indices, got {indices.dtype}.")
            if indices.shape != lists.alphas.shape:
                raise ValueError(
                    f"{name} of the lists must have the shape of alphas, {tuple(lists.alphas.shape)}, got "
                    f"{tuple(indices.shape)}."
                )
        background = _background_of(lists, background)
        _check_values(lists, background)
        return lists, background


CHUNK_ENTRIES = 1 << 20
"""Entries between two states that are kept for the backward pass, which computes again what is between them."""


class _Walk(NamedTuple):
    """The entries of all lists, from back to front: first the last of the longest list, finally the nearest of all.

    Pixels are sorted by the length of their lists, the longest first. So the entries of one place belong to the first
    pixels, as many as there are entries: a step of the recursion from back to front takes slices, without padding.

    Args:
        counts: number of entries of each place.
        gaussians: of the entries, shape (P,).
        alphas: of the entries, shape (P,).
        values: red, green, blue and 1 of all Gaussians, shape (N, 4); the 1 gives the alpha.
        background: the colors behind the sorted pixels, and 0, shape (H * W, 4).
        factors: mean and variance of every Gaussian's factor, () or (N,).
        ranks: the place of every pixel among the sorted ones, shape (H * W,).
        shape: of the image, (H, W).
    """

    counts: list[int]
    gaussians: Tensor
    alphas: Tensor
    values: Tensor
    background: Tensor
    factors: tuple[Tensor, Tensor]
    ranks: Tensor
    shape: tuple[int, int]

    @classmethod
    def over(cls, lists: PixelLists, background: Tensor, multiplier: Multiplier) -> _Walk:
        """Sort the entries of the lists."""
        size, entries, device = len(background), len(lists.alphas), background.device
        dtype = torch.int32 if max(size, entries) < 2**31 else torch.int64
        mean, variance = (_per_gaussian(getattr(multiplier, name), name, lists) for name in ("mean", "variance"))
        pixels, order = torch.sort(lists.pixels.to(dtype), stable=True)
        starts = torch.searchsorted(pixels, torch.arange(size + 1, dtype=dtype, device=device)).to(dtype)
        lengths, by_length = torch.sort(starts.diff(), stable=True, descending=True)
        ranks = torch.empty_like(starts[1:]).scatter_(0, by_length, torch.arange(size, dtype=dtype, device=device))
        lengths = lengths.flip(0).cpu()  # the one wait for a GPU
        counts = size - torch.searchsorted(
            lengths, torch.arange(int(lengths[-1]), dtype=dtype, device="cpu"), right=True
        )
        offsets = (counts.sum() - counts.cumsum(0)).to(device, dtype, non_blocking=True)
        places = torch.arange(entries, dtype=dtype, device=device).sub_(starts.index_select(0, pixels))
        target = offsets.index_select(0, places).add_(ranks.index_select(0, pixels))
        del pixels, places  # memory
        order = torch.empty_like(order).scatter_(0, target.long(), order)
        return cls(
            counts.flip(0).tolist(),
            lists.gaussians.index_select(0, order),
            lists.alphas.index_select(0, order),
            torch.cat([lists.colors, torch.ones_like(lists.colors[:, :1])], dim=1),
            torch.nn.functional.pad(background, (0, 1)).index_select(0, by_length),
            (mean, variance),
            ranks,
            (lists.height, lists.width),
        )

    def moments(self, terms: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the values, (4, H, W); ``terms`` collects what `_advance` does, by chunk."""
        # Nothing is kept for the backward pass but the states between chunks: it computes again what is between them.
        again = partial(checkpoint, _advance, use_reentrant=False, preserve_rng_state=False)
        advance = again if terms is None and torch.is_grad_enabled() else partial(_advance, terms=terms)
        mean = variance = self.background[:0]
        chunks = self._chunks()
        ends = [0, *(counts[-1] for counts, _, _ in chunks), len(self.ranks)]
        *backgrounds, rest = torch.split(self.background, [b - a for a, b in pairwise(ends)])
        for chunk, begins in zip(chunks, backgrounds, strict=True):
            mean, variance = advance(*chunk, mean, variance, begins, self.values, *self.factors)
        moments = torch.cat([mean, rest]), torch.cat([variance, torch.zeros_like(rest)])
        mean, variance = (x.index_select(0, self.ranks).T.reshape(4, *self.shape) for x in moments)
        return mean, variance

    def shares(self, weights: Tensor) -> Tensor:
        """Return what each Gaussian adds to the variance, mean over RGB, weighted by pixels (H, W); (N,), float64."""
        terms: list[Tensor] = []
        self.moments(terms)
        front = torch.empty_like(self.background[:, 0], dtype=torch.float64)
        front.scatter_(0, self.ranks.long(), weights.to(front).flatten())
        out = front.new_zeros(len(self.values))
        for (counts, gaussians, alphas), term in zip(reversed(self._chunks()), reversed(terms), strict=True):
            # From the front: a splat scales the variance of all that is behind it.
            shrink, parts = _spread(alphas, gaussians, *self.factors)[2], list[Tensor]()
            for t, factor in zip(
                reversed(torch.split(term, counts)), reversed(torch.split(shrink, counts)), strict=True
            ):
                front = front[: len(t)]
                parts.append(front * t)
                front = front * factor
            out.index_add_(0, gaussians, torch.cat(parts[::-1]))
        return out

    def blend_weights(self) -> tuple[Tensor, Tensor]:
        """Return alpha times transmittance of every entry, and the place of its pixel among the sorted ones."""
        light, parts = torch.ones_like(self.background[:, 0]), list[Tensor]()
        for alphas in reversed(torch.split(self.alphas, self.counts)):  # from the front
            parts.append(alphas * (light := light[: len(alphas)]))
            light = light * (1.0 - alphas)
        places = [torch.arange(count, dtype=self.ranks.dtype, device=self.ranks.device) for count in self.counts]
        none = self.ranks[:0]
        return torch.cat([self.alphas[:0], *reversed(parts)]), torch.cat([none, *places])

    def _chunks(self) -> list[tuple[list[int], Tensor, Tensor]]:
        """Return counts, Gaussians and alphas of all entries, whole places and about `CHUNK_ENTRIES` entries at a time.

        Work per Gaussian and per pixel costs as much for one chunk as for all entries, so a chunk has several times as
        many entries as there are Gaussians or pixels.
        """
        least = max(CHUNK_ENTRIES, 4 * len(self.ranks), 4 * len(self.values))
        counts: list[list[int]] = []
        room = 0
        for count in self.counts:
            if room <= 0:
                counts.append([])
                room = least
            counts[-1].append(count)
            room -= count
        sizes = [sum(x) for x in counts]
        return list(zip(counts, torch.split(self.gaussians, sizes), torch.split(self.alphas, sizes), strict=True))


def _spread(alphas: Tensor, gaussians: Tensor, *factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the expected alphas, their variances, and the factors on the variance of what is behind them."""
    m, v = (x.index_select(0, gaussians) if x.ndim else x for x in factors)
    expected, spread = m * alphas, v * alphas.square()
    return expected, spread, (1.0 - expected).square() + spread


def _advance(
    counts: list[int], gaussians: Tensor, alphas: Tensor, mean: Tensor, variance: Tensor, background: Tensor,
    values: Tensor, *factors: Tensor, terms: list[Tensor] | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Carry mean and variance of what is behind, (B, 4), over a chunk of entries, see `ca_reg.functional.moments`.

    ``background`` is that of the pixels whose lists begin here. ``terms`` collects the summands of the variance, mean
    RGB, of all entries.
    """
    columns = (*(x[:, None] for x in _spread(alphas, gaussians, *factors)), values.index_select(0, gaussians))
    begins = torch.split(background, [b - a for a, b in pairwise([len(mean), *counts])])
    found = []
    for expected, spread, shrink, value, new in zip(*(torch.split(x, counts) for x in columns), begins, strict=True):
        if len(new):
            mean, variance = torch.cat([mean, new]), torch.cat([variance, torch.zeros_like(new)])
        term = spread * (value - mean).square()
        variance = torch.addcmul(term, shrink, variance)
        # lerp, not a sum of products: equal colors then have exactly zero contrast, without rounding errors.
        mean = torch.lerp(mean, value, expected)
        if terms is not None:
            found.append(term[:, :3].mean(1))
    if terms is not None:
        terms.append(torch.cat(found))
    return mean, variance


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


def _per_gaussian(moment: float | Tensor, name: str, lists: PixelLists) -> Tensor:
    """Return a moment of the multiplier, () if it is a number, else one value per Gaussian, (N,)."""
    if not isinstance(moment, Tensor):
        return lists.alphas.new_full((), moment)
    n = lists.colors.shape[0]
    if moment.shape not in ((n,), (n, 1)):
        raise ValueError(
            f"the {name} of the multiplier must be a number or have shape ({n},) or ({n}, 1), one value per Gaussian, "
            f"got {tuple(moment.shape)}."
        )
    return moment.to(lists.alphas).flatten()


def _check_values(lists: PixelLists, background: Tensor) -> None:
    """Raise unless indices and alphas are in their ranges and colors finite; one wait for a GPU."""
    found = [lists.colors.sum(), background.sum()]
    if len(lists.alphas):
        found += [x for given in (lists.gaussians, lists.pixels, lists.alphas) for x in torch.aminmax(given)]
    color_sum, background_sum, *ends = torch.stack([x.detach().double() for x in found]).tolist()
    if ends:
        indices, (least, most) = (("gaussians", len(lists.colors)), ("pixels", len(background))), ends[4:]
        for (name, end), low, high in zip(indices, ends[:4:2], ends[1:4:2], strict=True):
            if low < 0 or high >= end:
                raise ValueError(f"{name} of the lists must be in [0, {end}), got values from {low:.0f} to {high:.0f}.")
        if not (least >= 0 and most <= 1):
            check_alphas(lists.alphas)
    if not math.isfinite(color_sum):  # those of Gaussians that are not listed may be anything
        listed = torch.zeros_like(lists.colors[:, 0], dtype=torch.bool)
        listed[lists.gaussians.long()] = True
        check_all_finite(lists.colors[listed], "colors")
    if not math.isfinite(background_sum):
        check_all_finite(background, "background")
