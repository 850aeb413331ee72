"""A simple, frozen renderer: the unit of speed measurements and, in float64, the reference for errors.

It is never optimized, so that a ratio to its speed means the same in every later measurement. For the same reason it
shares no code and no constants with the renderer.
"""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera

__all__ = ["render_simply"]

_NEAR, _DILATION, _MARGIN = 0.2, 0.3, 1.3
_MAX_ALPHA, _MIN_ALPHA, _MIN_LIGHT = 0.99, 1 / 255, 1e-4
_TILE = 16


def render_simply(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, camera: Camera
) -> Tensor:
    """Render Gaussians over black by the textbook formulas, tile by tile, with autograd's own backward pass.

    A tile of 16 x 16 pixels considers every Gaussian whose bounding box at alpha = 1/255 overlaps it, so nothing that
    the definition draws is left out: in float64 the result is that of brute force.

    Convention: OpenCV camera, half-pixel centers, wxyz quaternions; the constants of the INRIA rasterizer; the gradient
    passes through the clamp at 0.99.

    Args:
        means: world coordinates, shape (N, 3).
        quaternions: need not be normalized, shape (N, 4).
        scales: standard deviations, shape (N, 3).
        opacities: activated, shape (N,).
        colors: RGB, shape (N, 3).
        camera: the view.

    Returns:
        The image, shape (3, H, W), differentiable. All pixel-Gaussian pairs are kept for the backward pass.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.5, 8.5, 16, 16)
        >>> image = render_simply(torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),
        ...                       torch.tensor([0.8]), torch.tensor([[1.0, 0.5, 0]]), camera)
        >>> [round(x, 3) for x in image[:, 8, 8].tolist()]
        [0.8, 0.4, 0.0]
    """
    view = camera.world_to_camera.to(means)
    depths = (means @ view[:3, :3].T + view[:3, 3])[:, 2].detach()
    order = torch.argsort(depths, stable=True)
    order = order[depths[order] > _NEAR]
    centers, covariances = _project(means[order], quaternions[order], scales[order], view, camera)
    opacities, colors = opacities[order], colors[order]
    inverses = torch.linalg.inv(covariances)
    with torch.no_grad():
        radii = torch.sqrt(2 * torch.log(opacities / _MIN_ALPHA).clamp(min=0))
        reach = radii[:, None] * covariances.diagonal(dim1=1, dim2=2).sqrt()
        low, high = centers - reach, centers + reach
    strips = []
    for top in range(0, camera.height, _TILE):
        strip = []
        for left in range(0, camera.width, _TILE):
            right, bottom = min(left + _TILE, camera.width), min(top + _TILE, camera.height)
            begin, end = means.new_tensor([left, top]), means.new_tensor([right, bottom])
            near = torch.nonzero(((high >= begin) & (low <= end)).all(dim=1)).squeeze(1)
            y, x = torch.meshgrid(
                torch.arange(top, bottom).to(means) + 0.5, torch.arange(left, right).to(means) + 0.5, indexing="ij"
            )
            pixels = torch.stack([x, y], dim=-1).view(-1, 2)
            sums = _blend(pixels, centers[near], inverses[near], opacities[near], colors[near])
            strip.append(sums.T.view(-1, bottom - top, right - left))
        strips.append(torch.cat(strip, dim=2))
    return torch.cat(strips, dim=1)


def _project(means: Tensor, quaternions: Tensor, scales: Tensor, view: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the projected means (M, 2) and the dilated covariances (M, 2, 2)."""
    rotation = view[:3, :3]
    x, y, z = (means @ rotation.T + view[:3, 3]).unbind(1)
    limit_x, limit_y = _MARGIN * camera.width / (2 * camera.fx), _MARGIN * camera.height / (2 * camera.fy)
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], dim=1)
    a, b, c, d = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    orientation = torch.stack(
        [
            a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c),
            2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b),
            2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d,
        ], dim=1,
    ).view(-1, 3, 3)  # fmt: skip
    half = jacobian.view(-1, 2, 3) @ rotation @ (orientation * scales[:, None, :])
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    return centers, half @ half.transpose(1, 2) + _DILATION * torch.eye(2).to(means)


def _blend(pixels: Tensor, centers: Tensor, inverses: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
    """Composite Gaussians, nearest first, at pixels (P, 2); return colors (P, C)."""
    dx, dy = (pixels[:, None] - centers).unbind(2)
    power = inverses[:, 0, 0] * dx * dx + 2 * inverses[:, 0, 1] * dx * dy + inverses[:, 1, 1] * dy * dy
    raw = opacities * torch.exp(-0.5 * power)
    alpha = raw + (raw.clamp(max=_MAX_ALPHA) - raw).detach()
    alpha = torch.where(raw >= _MIN_ALPHA, alpha, 0.0)
    behind = torch.cumprod(1 - alpha, dim=1)
    weights = torch.where(behind >= _MIN_LIGHT, alpha * behind / (1 - alpha), 0.0)
    return weights @ colors
