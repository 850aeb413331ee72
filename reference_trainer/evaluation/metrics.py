"""Metrics of images in float64, PSNR, SSIM and depth errors, and per-pixel maps: color variance, first-order score."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.nn.functional import pad

from ca_reg.functional import Multiplier
from reference_trainer.render.renderer import rasterize
from reference_trainer.render.splats import Splats
from reference_trainer.render.torch import compositing
from reference_trainer.render.torch.compositing import geometry_rows, walk
from reference_trainer.scenes.scene import View

__all__ = [
    "DepthErrors", "color_variance_map", "counted", "depth_errors", "first_order_map", "on_white", "psnr", "ssim",
    "view_psnr",
]  # fmt: skip

_WINDOW = 11


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio ``-10 log10(mean squared error)`` of images (3, H, W); the peak is 1.

    In decibels, computed in float64; infinite for equal images, nan if no pixel counts of a mask (H, W), such as DTU's
    object (`counted`). For several images report the mean of their PSNR, as the papers do, not the PSNR of the pooled
    error. Raises ValueError if the shapes differ, are not (C, H, W), or a value is not finite.

    Example:
        >>> import torch
        >>> round(psnr(torch.full((3, 4, 4), 0.5), torch.full((3, 4, 4), 0.6)), 3)
        20.0
    """
    x, y = _checked(image, target)
    error = counted((x - y).square(), mask).mean().item()
    return math.inf if error == 0 else -10 * math.log10(error)


def view_psnr(render: Tensor, view: View) -> float:
    """Return the PSNR of a render (3, H, W) of a view, not clamped, as its photograph was exposed, within its mask."""
    return psnr(view.as_taken(render).clamp(0, 1), view.as_taken(view.image), view.mask)


def counted(image: Tensor, mask: Tensor | None) -> Tensor:
    """Return the pixels of an image (C, H, W) where a mask (H, W) in [0, 1] rounds to 255 in 8 bits, or all: (C, P)."""
    return image.flatten(1) if mask is None else image[:, mask > 254.5 / 255]


def ssim(image: Tensor, target: Tensor) -> float:
    """Return the structural similarity of the Gaussian-splatting papers (the INRIA code's variant) of images (3, H, W).

    That is Wang et al. (2004) with an 11 x 11 Gaussian window of sigma 1.5, zero padding, constants 0.01^2 and 0.03^2,
    population variances, and the mean over all pixels and channels. scikit-image crops the border instead, so its
    numbers differ. In [-1, 1], computed in float64, because in float32 it can exceed 1. Errors are those of `psnr`.

    Example:
        >>> import torch
        >>> ssim(torch.full((3, 16, 16), 0.5), torch.full((3, 16, 16), 0.5))
        1.0
    """
    x, y = (pad(z[None], (_WINDOW // 2,) * 4) for z in _checked(image, target))
    # eps would shift every value by 1e-12 / denominator; the constants already keep the denominator positive.
    return float(kornia_ssim(x, y, _WINDOW, max_val=1.0, eps=0.0, padding="valid").mean().item())


class DepthErrors(NamedTuple):
    """Errors of a depth d against the true depth t (Eigen et al. 2014), averaged over pixels; nan without t."""

    abs_rel: float = math.nan  # |d - t| / t
    rmse: float = math.nan
    mae: float = math.nan  # |d - t|
    log10: float = math.nan  # |log10 d - log10 t|, over the pixels where d is positive


def depth_errors(depth: Tensor, truth: Tensor) -> DepthErrors:
    """Return the errors of a depth (H, W) over the pixels where the true depth is known, that is not 0; in float64.

    Both are along the camera's z axis, in world units. The depth of a render is its accumulated depth divided by alpha.
    No scale or shift is fitted.

    Example:
        >>> import torch
        >>> depth_errors(torch.tensor([[20.0, 5.0]]), torch.tensor([[2.0, 0.0]]))
        DepthErrors(abs_rel=9.0, rmse=18.0, mae=18.0, log10=1.0)
    """
    known = truth > 0
    d, t = depth[known].double(), truth[known].double()
    error, seen = d - t, d > 0
    means = (error.abs() / t).mean(), error.square().mean().sqrt(), error.abs().mean()
    return DepthErrors(*(x.item() for x in (*means, (d[seen].log10() - t[seen].log10()).abs().mean())))


def on_white(image: Tensor, mask: Tensor | None) -> Tensor:
    """Return an image (3, H, W) as SSIM and LPIPS see it in the DTU protocol: white outside the mask (H, W)."""
    return image if mask is None else image * mask + 1 - mask


def _checked(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Check both images; return them detached, in float64."""
    if image.ndim != 3 or image.shape != target.shape:
        raise ValueError(
            f"image and target must share one shape (3, H, W), got {tuple(image.shape)} and {tuple(target.shape)}."
        )
    x, y = image.detach().double(), target.detach().double()
    if not bool(x.isfinite().all() and y.isfinite().all()):
        raise ValueError("image and target must be finite; the rendering or the photograph holds NaN or infinity.")
    return x, y


@torch.no_grad()
def color_variance_map(splats: Splats) -> tuple[Tensor, Tensor]:
    """Measure the variance of the colors blended at each pixel (paper, appendix, CV metric).

    `ca_reg.functional.color_variance` without the lists of the pixels: a difference of mean squares, from two renders.
    It is taken around the mean color of the image, so what it loses by cancellation is a rounding of the squared
    distance from that color, not of the squared color.

    Returns the variance, averaged over RGB, (H, W), and where any splat contributes, (H, W) bool; elsewhere the
    variance is 0. The image's CV is the mean over the contributing pixels.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.tensor([[0.0, 0, 0], [1.0, 1, 1]]))
        >>> variance, covered = color_variance_map(splats)
        >>> round(variance[8, 8].item(), 2)  # weights 1/2 and 1/4: (1/3) (2/3)
        0.22
    """
    rendering = rasterize(splats)
    covered = rendering.alpha > 0
    weight = torch.where(covered, rendering.alpha, 1.0)
    center = rendering.image.sum((1, 2)) / rendering.alpha.sum().clamp_min(torch.finfo(weight.dtype).tiny)
    offsets = splats.colors - center
    first, second = (rasterize(splats._replace(colors=x)).image / weight for x in (offsets, offsets.square()))
    return (second - first.square()).mean(0).clamp_min(0.0), covered


@torch.no_grad()
def first_order_map(splats: Splats, multiplier: Multiplier) -> Tensor:
    """Render ``v sum_i (c_i alpha_i)^2``, the paper's closed form (appendix, Eq. ca_final, where v is ``p (1 - p)``).

    An approximation that ignores transmittance, the background and what lies behind a splat: hidden splats count like
    visible ones. `ca_reg.functional.first_order_variance` says when it holds. Arguments are those of `render_moments`,
    of the multiplier only the variance counts; returns shape (3, H, W). Always rendered by the torch engine.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.5, 8.5, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.ones(2, 3))
        >>> round(first_order_map(splats, Multiplier.dropout(0.5))[0, 8, 8].item(), 3)  # 0.25 (0.25 + 0.25)
        0.125
    """
    spread = multiplier.variance
    if isinstance(spread, Tensor):
        spread = spread[splats.indices].to(splats.colors)[:, None]
    rows = torch.cat([geometry_rows(splats), (spread * splats.colors.square()).T])
    background = rows.new_zeros(3, splats.lists.height, splats.lists.width)
    return walk(compositing.first_order, rows, background, splats.lists, extra=0)
