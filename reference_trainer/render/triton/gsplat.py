"""The exact score of a gsplat model over the lists that gsplat made: one pass, no projection, nothing to compile.

gsplat's ``meta`` (1.4, 1.5, main) holds what the moments need: ``means2d, conics, opacities``, and for every tile of
``tile_size`` pixels the splats in depth order, ``isect_offsets, flatten_ids``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from ca_reg.integrations.gsplat import unregularized_calls, version_numbers
from ca_reg.types import ExactMoments
from reference_trainer.render.triton.moments import moments_of, shares_of
from reference_trainer.render.triton.tiles import Lists

__all__ = ["GsplatMoments"]


class GsplatMoments:
    """A moments callable for `ca_reg.CAScore` from gsplat's ``meta``; not differentiable, one camera per call.

    A regularizer that wraps or replaces ``gsplat.rasterization`` is bypassed, as the multiplier takes its place.

    Args:
        rasterize: ``rasterize(opacities, view)`` returns the colors of all N Gaussians towards the view, RGB, (N, 3),
            and gsplat's ``meta`` of a render with these activated opacities, (N,) or (N, 1); packed or not. Such is
            ``rasterized`` of a `ca_reg.integrations.gsplat_model.GsplatModel`.
        background: the model's own, shape (3,); None for black.
        max_alpha: where this gsplat clamps alphas; by default that of the installed version, 0.999 before 1.6, which
            is then 0.99.

    Example:
        >>> from ca_reg import CAScore
        >>> moments = GsplatMoments(
        ...     lambda opacities, view: (rgb, gsplat.rasterization(means, quats, scales, opacities, rgb, **view)[2])
        ... )  # doctest: +SKIP
        >>> CAScore.exact(moments)(opacities, view).value  # doctest: +SKIP
    """

    def __init__(
        self,
        rasterize: Callable[[Tensor, Any], tuple[Tensor, Mapping[str, Any]]],
        *,
        background: Tensor | None = None,
        max_alpha: float | None = None,
    ) -> None:
        self.rasterize = rasterize
        self.background = background
        self.max_alpha = max_alpha

    def __call__(self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None) -> ExactMoments:
        """Return the exact moments of a view: mean and variance (3, H, W) and the expected alpha (H, W).

        Raises:
            ValueError: if ``meta`` is of several cameras or of tiles whose side is no power of two, or the colors are
                not RGB of all Gaussians.
        """
        table, lists, background, _ = self._prepared(opacity, view, multiplier, background)
        return ExactMoments(*moments_of(table, lists, background))

    def shares(
        self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None, weights: Tensor
    ) -> Tensor:
        """Return every Gaussian's share of the weighted variance, (N,), float64, as `ca_reg.ListMoments.shares`."""
        table, lists, background, which = self._prepared(opacity, view, multiplier, background)
        found = shares_of(table, lists, background, weights.to(table))
        return found if which is None else found.new_zeros(len(opacity)).index_add(0, which, found)

    @torch.no_grad()
    def _prepared(
        self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None
    ) -> tuple[Tensor, Lists, Tensor, Tensor | None]:
        """Return the table of the listed splats, the lists, the background, and which Gaussians the splats are."""
        with unregularized_calls():
            colors, meta = self.rasterize(opacity, view)
        if meta["isect_offsets"].shape[:-2].numel() != 1:
            raise ValueError(f"meta must be of one camera, got isect_offsets {tuple(meta['isect_offsets'].shape)}.")
        if colors.shape != (len(opacity), 3):
            raise ValueError(f"colors must be RGB of all Gaussians, {(len(opacity), 3)}, got {tuple(colors.shape)}.")
        tile = int(meta["tile_size"])
        if tile & (tile - 1):
            raise ValueError(f"tile_size must be a power of two, got {tile}: rasterize with tile_size=16.")
        a, b, c = meta["conics"].reshape(-1, 3).float().unbind(1)
        # The conic ((a, b), (b, c)) is the square of its triangular factor: l11^2 = a, l11 l21 = b, l21^2 + l22^2 = c.
        l11 = a.clamp_min(1e-30).sqrt()
        l21 = b / l11
        l22 = (c - l21 * l21).clamp_min(0).sqrt()
        which = meta.get("gaussian_ids") if meta["conics"].ndim == 2 else None  # of packed splats

        def rows(values: float | Tensor) -> Tensor:
            if not isinstance(values, Tensor):
                return torch.full_like(a, values)[:, None]
            values = values.reshape(len(opacity), -1).to(a)
            return values if which is None else values[which]

        log_opacity = meta["opacities"].reshape(-1, 1).float().clamp_min(1e-30).log2()
        columns = (meta["means2d"].reshape(-1, 2), torch.stack([l11, l21, l22], 1), log_opacity, rows(colors))
        table = torch.cat([*columns, rows(multiplier.mean), rows(multiplier.variance)], dim=1).float()
        ids, size = meta["flatten_ids"].int(), (3, int(meta["height"]), int(meta["width"]))
        starts = torch.cat([meta["isect_offsets"].flatten().int(), ids.new_full((1,), len(ids))])
        lists = Lists(starts, ids, size[2], size[1], tile, self.max_alpha or _max_alpha())
        background = self.background if background is None else background
        background = a.new_zeros(3) if background is None else background.to(a)
        return table, lists, (background if background.ndim == 3 else background[:, None, None]).expand(size), which


def _max_alpha() -> float:
    """Return where the installed gsplat clamps alphas."""
    version = importlib.import_module("gsplat").__version__  # it is distributed by another name too: amd-gsplat
    return 0.999 if version_numbers(version) < [1, 6] else 0.99
