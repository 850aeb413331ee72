"""Render Gaussians: tensors and a camera in, an image out, or the exact moments of its colors."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.render.checks import check_projection, checked_background, checked_colors, new_background
from reference_trainer.render.engine import engine_for
from reference_trainer.render.splats import MomentImages, Rendering, Splats

__all__ = ["rasterize", "render", "render_masks", "render_moments", "splat", "variance_shares"]


def splat(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    *,
    sh: Tensor | None = None,
    sh_degree: int | None = None,
    colors: Tensor | None = None,
    background: Tensor | None = None,
) -> Splats:
    """Project Gaussians, evaluate their colors and list them per tile.

    Gaussians that cannot be seen (behind the near plane, or with an opacity below `MIN_ALPHA`, such
    as dropped ones) are left out before the projection and cost nothing. The arguments are those of
    `render`; a background is only looked at here, where that takes no further wait for a card.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if not exactly one of ``sh`` and ``colors`` is given, a tensor has the wrong
            shape, or the world coordinates are too large for their precision, see `MAX_ROUNDING`.
        NotFiniteError: if an input that affects the view is nan or infinite. Of Gaussians behind
            the camera, or dropped, only position and opacity must be finite.
        NotImplementedError: if the camera's pose requires a gradient, which the engine torch alone computes.
    """
    values, degree = checked_colors(sh, sh_degree, colors)
    n = means.shape[0]
    if opacities.shape not in ((n,), (n, 1)):
        raise ValueError(f"opacities must have shape ({n},) or ({n}, 1), got {tuple(opacities.shape)}.")
    # Shapes are checked here, once for all engines: compiled loops would read beyond the ends.
    named = {"means": means, "quaternions": quaternions, "scales": scales, "colors" if degree is None else "sh": values}
    for (name, x), shape in zip(named.items(), ((n, 3), (n, 4), (n, 3), (n, *values.shape[1:])), strict=True):
        if x.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(x.shape)}.")
    named["opacities"] = opacities.reshape(n)
    inputs = {name: _working(name, x, means.dtype) for name, x in named.items()}
    # Mixed precision would move means by pixels: its products have 8 bits.
    with torch.autocast(means.device.type, enabled=False):
        camera = camera.to(means.device, inputs["means"].dtype)
        engine = engine_for(means.device, inputs["means"].dtype)
        background = new_background(background, means.device)
        projected = engine.project(inputs, camera, degree, background)
        check_projection(projected, inputs, camera, background)
        # Which tile a splat touches is a decision, not a quantity: nothing flows through the lists.
        with torch.no_grad():
            lists = engine.bin(projected, camera.width, camera.height)
        return Splats(projected.indices, projected.projection, projected.opacities, projected.colors, lists, engine)


def _working(name: str, x: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an input in working precision: float64 if the means are, else float32."""
    if not x.is_floating_point():
        raise TypeError(f"{name} must be a floating-point tensor, got {x.dtype}; convert it with .float().")
    return x.to(torch.float64 if dtype == torch.float64 else torch.float32)


def render(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    *,
    sh: Tensor | None = None,
    sh_degree: int | None = None,
    colors: Tensor | None = None,
    background: Tensor | None = None,
    depth: bool = False,
) -> Rendering:
    """Render 3D Gaussians; differentiable in every tensor, once: second derivatives lack what the pixels add.

    Convention: OpenCV camera, half-pixel centers, wxyz quaternions; the constants of the INRIA
    rasterizer. The work is done in float64 if the means are, else in float32: also for float16 and
    bfloat16 inputs, and inside torch.autocast.

    Args:
        means: world coordinates, shape (N, 3).
        quaternions: orientation, need not be normalized, shape (N, 4).
        scales: standard deviations along the axes, positive, shape (N, 3).
        opacities: activated, in [0, 1], shape (N,) or (N, 1).
        camera: the view.
        sh: spherical-harmonic coefficients, shape (N, K, 3); give either these or ``colors``.
        sh_degree: highest band to evaluate, at most 3; all of ``sh`` by default.
        colors: RGB, shape (N, 3).
        background: color behind everything, shape (3,); black by default.
        depth: whether to accumulate depth as well.

    Returns:
        Image, accumulated alpha, depth if asked for, and the splats.

    Raises:
        TypeError, ValueError, NotFiniteError, NotImplementedError: as `splat`; the second and third also for the
            background.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> out = render(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),
        ...              torch.tensor([0.8]), camera, colors=torch.tensor([[1.0, 0.5, 0.0]]))
        >>> out.image.shape, round(out.alpha.max().item(), 1)
        (torch.Size([3, 32, 32]), 0.8)
    """
    splats = splat(
        means, quaternions, scales, opacities, camera, sh=sh, sh_degree=sh_degree, colors=colors, background=background
    )
    return rasterize(splats, background=background, depth=depth)


def rasterize(splats: Splats, *, background: Tensor | None = None, depth: bool = False) -> Rendering:
    """Composite the splats of `splat`; other arguments and errors are those of `render`."""
    # Projected centers are no leaves; density control reads their gradient all the same.
    if splats.projection.means.requires_grad:
        splats.projection.means.retain_grad()
    with torch.autocast(splats.opacities.device.type, enabled=False):
        image, alpha, depths = splats.engine.composite(
            splats, checked_background(background, splats, (3,)), depth=depth
        )
    return Rendering(image, alpha, depths, splats)


@torch.no_grad()
def render_masks(splats: Splats, opacities: Tensor, *, background: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Render the same Gaussians K times with lower opacities, projecting and sorting once.

    Args:
        splats: of a view.
        opacities: activated, of all N Gaussians, (K, N), nowhere higher than those of the splats; 0
            leaves a Gaussian out, at no cost.
        background: as for `render`.

    Returns:
        Images (K, 3, H, W) and accumulated alphas (K, H, W), without gradients.
    """
    lower = opacities[:, splats.indices].to(splats.opacities.dtype)
    if not len(lower):
        size = splats.lists.height, splats.lists.width
        return lower.new_empty(0, 3, *size), lower.new_empty(0, *size)
    with torch.autocast(lower.device.type, enabled=False):
        return splats.engine.composite_masks(splats, lower, checked_background(background, splats, (3,)))


def render_moments(splats: Splats, multiplier: Multiplier, *, background: Tensor | None = None) -> MomentImages:
    """Render exact mean and variance of a view under random factors on the alphas.

    Differentiable once. The factors are independent per splat. There is no early stop: splats behind an
    opaque surface shine through its dropped ones.

    Args:
        splats: of the full model, with its plain opacities.
        multiplier: moments of the factor, numbers for all Gaussians, or tensors of shape (N,) or (N, 1),
            one value each.
        background: fixed color behind everything, shape (3,), or one for each pixel, (3, H, W);
            black by default.

    Raises:
        ValueError: if the background has another shape, or is not finite.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> splats = splat(torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 1.0),
        ...                torch.tensor([0.8]), camera, colors=torch.ones(1, 3))
        >>> moments = render_moments(splats, Multiplier.dropout(0.5))
        >>> round(moments.mean[0, 8, 8].item(), 2), round(moments.variance[0, 8, 8].item(), 2)  # 0.5 x 0.8, 0.25 x 0.64
        (0.4, 0.16)
    """
    with torch.autocast(splats.colors.device.type, enabled=False):
        return splats.engine.moments(splats, _factors(multiplier, splats), _background_image(background, splats))


@torch.no_grad()
def variance_shares(
    splats: Splats, multiplier: Multiplier, weights: Tensor, *, background: Tensor | None = None
) -> Tensor:
    """Attribute a weighted sum of the variance over the pixels to the Gaussians.

    The shares add up to it. A Gaussian's share at a pixel is its summand of the variance,
    `ca_reg.functional.contributions`, mean over RGB.

    The weights have shape (H, W); 1 / count in the region of a score gives shares of that score.
    Other arguments are those of `render_moments`. Returns one share for every projected Gaussian
    (``splats.indices``), (M,), float64.

    Raises:
        ValueError: if the weights or the background have another shape.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> from reference_trainer.render import splat
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.0, 8.0, 16, 16)
        >>> means, quaternions = torch.tensor([[0.0, 0, 1], [0.1, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2)
        >>> splats = splat(means, quaternions, torch.full((2, 3), 0.2), torch.full((2,), 0.5), camera,
        ...                colors=torch.tensor([[0.0, 0, 0], [1.0, 1, 1]]))
        >>> shares = variance_shares(splats, Multiplier.dropout(0.5), torch.full((16, 16), 1 / 256))
        >>> variance = render_moments(splats, Multiplier.dropout(0.5)).variance
        >>> torch.allclose(shares.sum(), variance.double().mean())
        True
    """
    shape = (splats.lists.height, splats.lists.width)
    if weights.shape != shape:
        raise ValueError(f"weights must have one value per pixel, shape {shape}, got {tuple(weights.shape)}.")
    with torch.autocast(splats.colors.device.type, enabled=False):
        return splats.engine.shares(
            splats, _factors(multiplier, splats), _background_image(background, splats), weights.to(splats.colors)
        )


def _background_image(background: Tensor | None, splats: Splats) -> Tensor:
    """Return the background of every pixel, (3, H, W)."""
    shape = (3, splats.lists.height, splats.lists.width)
    found = checked_background(background, splats, (3,), shape)
    return (found if found.ndim == 3 else found[:, None, None]).expand(shape)


def _factors(multiplier: Multiplier, splats: Splats) -> Tensor:
    """Return mean and variance of every projected Gaussian's factor, (M, 2)."""
    found = splats.opacities.new_empty(len(splats.opacities), 2)
    for i, x in enumerate((multiplier.mean, multiplier.variance)):
        found[:, i] = x.flatten()[splats.indices] if isinstance(x, Tensor) else x
    return found
