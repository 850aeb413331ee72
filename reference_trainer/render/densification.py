"""What density control reads of a view: radii on the screen, blend weights, absolute gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ca_reg._precision import at_least_single
from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION, NEAR_PLANE
from reference_trainer.render.renderer import rasterize
from reference_trainer.render.splats import Rendering, Splats
from reference_trainer.render.torch.projection import project

__all__ = [
    "MAX_RADIUS", "SMALLEST_SPREAD", "absgrad_sink", "in_front", "longer_radii", "splat_weights", "visible_radii",
    "with_absolute_gradients",
]  # fmt: skip

SMALLEST_SPREAD = 0.1**0.5  # px^2, of the INRIA code
MAX_RADIUS = 2.0**31 - 128  # pixels, the largest float32 that is an int32: CUDA's conversion ends there as well
# Pixels; a Gaussian is visible to the INRIA code if the square around it meets a tile of the image.
CUDA_TILE = 16


def in_front(means: Tensor, camera: Camera) -> Tensor:
    """Return which Gaussians, means (N, 3), lie beyond the near plane, shape (N,) bool."""
    means = at_least_single(means.detach())
    pose = camera.world_to_camera.to(means)
    return means @ pose[2, :3] + pose[2, 3] > NEAR_PLANE


@torch.no_grad()
def longer_radii(covariances: Tensor, smallest: float) -> Tensor:
    """Return three standard deviations of the longer axis of 2D covariances (M, 3), rounded up, at most `MAX_RADIUS`.

    More for round splats: half the difference of the axes' variances counts as at least
    ``smallest``.

    Example:
        >>> longer_radii(torch.tensor([[1.0, 0.0, 1.0], [9.0, 0.0, 1.0]]), SMALLEST_SPREAD).tolist()  # 3 sqrt(1.32), 9
        [4.0, 9.0]
    """
    xx, xy, yy = covariances.unbind(-1)
    spread = torch.hypot(0.5 * (xx - yy), xy).clamp_min(smallest)
    return torch.ceil(3.0 * (0.5 * (xx + yy) + spread).sqrt()).clamp_max(MAX_RADIUS)


@torch.no_grad()
def visible_radii(
    means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera, *, blur: float = DILATION
) -> Tensor:
    """Return the radii of splats on the screen, pixels, (N,) int32; 0 for those off the image.

    As in the originals the opacity does not matter: a Gaussian of opacity 0 has a radius, though it
    is not rendered. Quaternions are wxyz, scales standard deviations, ``blur`` is in square pixels. As for a rendering
    the work is done in float64 if the means are, else in float32.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 16.0, 16.0, 32, 32)
        >>> means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [9.0, 0.0, 1.0]])
        >>> visible_radii(means, torch.eye(4)[:1].repeat(3, 1), torch.full((3, 3), 0.1), camera).tolist()
        [16, 0, 0]
    """
    means = at_least_single(means)
    quaternions, scales = quaternions.to(means), scales.to(means)
    radii = torch.zeros(means.shape[0], dtype=torch.int32, device=means.device)
    front = torch.nonzero(in_front(means, camera)).squeeze(1)
    camera = camera.to(means.device, means.dtype)
    splats = project(means[front], quaternions[front], scales[front], camera, dilation=blur)
    center = splats.means - 0.5  # in the INRIA code pixel centers are integers
    tiles = center.new_tensor([-(-camera.width // CUDA_TILE), -(-camera.height // CUDA_TILE)])
    extents = longer_radii(splats.covariances, SMALLEST_SPREAD)
    first = ((center - extents[:, None]) / CUDA_TILE).trunc().clamp(min=0.0).minimum(tiles)
    last = ((center + extents[:, None] + CUDA_TILE - 1) / CUDA_TILE).trunc().clamp(min=0.0).minimum(tiles)
    radii[front] = torch.where((last > first).all(-1), extents, 0.0).to(torch.int32)
    return radii


def splat_weights(splats: Splats) -> Tensor:
    """Sum every splat's alpha times transmittance over the pixels of the image, shape (M,)."""
    # The image is linear in the colors: the gradient of the sum of red is the sum of the weights.
    with torch.inference_mode(False), torch.enable_grad():  # inference mode would record no gradient
        colors = torch.zeros_like(splats.colors).requires_grad_()
        red = rasterize(splats._replace(colors=colors)).image[0].sum()
        return torch.autograd.grad(red, colors)[0][:, 0]


class _AbsoluteGradients(torch.autograd.Function):
    """The identity; backward also hands the sums of absolute gradients to another input."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, sink: Tensor, splats: Splats, background: Tensor) -> Tensor:
        ctx.splats, ctx.background = splats, torch.nn.functional.pad(background, (0, 1))[:, None, None]
        ctx.save_for_backward(rendered)
        return rendered.view_as(rendered)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        # image = black + (1 - alpha) background, where black is the image over a black background.
        # Engines take the gradients of black and alpha; alpha's is less by gradient . background.
        (rendered,), (gradient,) = ctx.saved_tensors, gradients
        black = torch.cat([rendered[:4] - (1 - rendered[4]) * ctx.background, rendered[4:]])
        of_alpha = gradient[4:] - (gradient[:4] * ctx.background).sum(0, keepdim=True)
        sums = ctx.splats.engine.absolute_gradients(ctx.splats, black, torch.cat([gradient[:4], of_alpha]))
        return gradient, sums, None, None


def absgrad_sink(means: Tensor) -> Tensor:
    """Return zeros like ``means`` whose gradient becomes ``means.absgrad`` (gsplat's name)."""
    sink = torch.zeros_like(means).requires_grad_()
    sink.register_hook(lambda gradient: setattr(means, "absgrad", gradient))  # type: ignore[no-untyped-call]
    return sink


def with_absolute_gradients(rendering: Rendering, sink: Tensor, background: Tensor | None = None) -> Rendering:
    """Return the rendering with a backward pass that also computes `Engine.absolute_gradients`.

    They become the gradient of ``sink`` (M, 2), whose values do not matter. The image's background
    (3,) is black by default.
    """
    depth = torch.zeros_like(rendering.alpha) if rendering.depth is None else rendering.depth
    background = rendering.image.new_zeros(3) if background is None else background.detach().to(rendering.image)
    rendered = torch.cat([rendering.image, depth[None], rendering.alpha[None]])
    rendered = _AbsoluteGradients.apply(rendered, sink, rendering.splats, background)  # type: ignore[no-untyped-call]
    return rendering._replace(
        image=rendered[:3], alpha=rendered[4], depth=None if rendering.depth is None else rendered[3]
    )
