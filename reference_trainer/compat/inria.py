"""The exact score of a model of the INRIA family in its own process, from what its render gives to its rasterizer."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from ca_reg.integrations._patching import rendered_once
from reference_trainer.compat.rasterizer import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    axes_of,
    camera_of,
    splats_of,
    warn_of_ignored,
)
from reference_trainer.render import MomentImages, Splats, render_moments, variance_shares
from reference_trainer.render.densification import splat_weights

__all__ = ["InriaMoments"]

_KNOWN = inspect.signature(GaussianRasterizer.forward).parameters


@dataclass(frozen=True, eq=False)
class InriaMoments:
    """A moments callable for `ca_reg.CAScore` from the ``render`` of an INRIA-style code base.

    Each call makes one render of theirs, and projects what their rasterizer was given with this package's renderer, as
    the stand-in of ``--cpu`` does: on a CPU or a card, without a file and without further CUDA code. What ``render``
    does to the picture afterwards (clamping, exposure, a learned background) is left out; settings and arguments that
    the stand-in does not know are ignored with one warning each. Differentiable in the opacities, in the multiplier,
    and in what the rasterizer was given.

    The arguments are those of `ca_reg.integrations.inria.render_fn`. As there, the opacities replace the model's, and a
    `ca_reg.integrations.inria.RasterizerHook` leaves these renders alone.

    Example:
        >>> from ca_reg import CAScore, attribute
        >>> moments = InriaMoments(render, gaussians, pipe, background)  # doctest: +SKIP
        >>> score = CAScore.exact(moments)  # doctest: +SKIP
        >>> attribute(score, moments.shares, gaussians.get_opacity, view).shares  # doctest: +SKIP
    """

    render: Callable[..., Any]
    gaussians: Any
    pipe: Any
    background: Tensor
    rasterizer: type | None = field(default=None, kw_only=True)

    def __call__(self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None) -> MomentImages:
        """Return the exact moments of a view: mean and variance (3, H, W) and the expected alpha (H, W).

        The opacities are activated, of all Gaussians, (N,) or (N, 1); the background is (3,) or (3, H, W), or None for
        the one that ``render`` gives to the rasterizer.

        Errors are those of `ca_reg.integrations.inria.render_fn`, but for the alpha, and a ValueError if ``render``
        gives covariances in place of scales and rotations, or matrices that are not those of a pinhole camera.
        """
        splats, background = self._splats(opacity, view, background)
        return render_moments(splats, multiplier, background=background)

    @torch.no_grad()
    def shares(
        self, opacity: Tensor, view: Any, multiplier: Multiplier, background: Tensor | None, weights: Tensor
    ) -> Tensor:
        """Return every Gaussian's share of the weighted variance, (N,), as `ca_reg.lists.ListMoments.shares`."""
        splats, background = self._splats(opacity, view, background)
        return splats.to_all(variance_shares(splats, multiplier, weights, background=background), len(opacity))

    @torch.no_grad()
    def weights(self, opacity: Tensor, view: Any) -> Tensor:
        """Return every Gaussian's blend weight, (N,), as `ca_reg.lists.ListMoments.weights`."""
        splats, _ = self._splats(opacity, view, None)
        return splats.to_all(splat_weights(splats).double(), len(opacity))

    def _splats(self, opacity: Tensor, view: Any, background: Tensor | None) -> tuple[Splats, Tensor]:
        """Project what ``render`` gives to the rasterizer; return its background as well, unless there is another."""
        arguments = view, self.gaussians, self.pipe, self.background
        with rendered_once(lambda: self.render(*arguments), opacity, self.rasterizer) as (_, call):
            given = call.arguments
        warn_of_ignored("argument", {name: x for name, x in given.items() if name not in _KNOWN})
        settings = GaussianRasterizationSettings(**call.rasterizer.raster_settings._asdict())
        means, covariances = given["means3D"], given.get("cov3D_precomp")
        with torch.autocast(means.device.type, enabled=False):  # as CUDA code does, which knows none
            scales, rotations = axes_of(settings, call.get("scales"), call.get("quaternions"), covariances)
            splats = splats_of(
                settings, means, rotations, scales, opacity, camera_of(settings),
                sh=call.get("sh"), colors=given.get("colors_precomp"),
            )  # fmt: skip
        return splats, settings.bg if background is None else background
