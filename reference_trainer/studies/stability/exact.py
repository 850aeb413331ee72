"""A renderer in decimal arithmetic of 60 digits, for needles so long that float64 itself is in doubt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from decimal import Decimal, localcontext

import torch

from reference_trainer.studies.stability.quantities import Quantities, loss_weights
from reference_trainer.studies.stability.scenes import PARAMETERS, StressScene

__all__ = ["exact_images"]

_DIGITS = 60
_STEP = Decimal("1e-20")  # of the central differences, relative: their error is of the order of its square
_NEAR, _DILATION, _MARGIN = Decimal("0.2"), Decimal("0.3"), Decimal("1.3")

Rows = list[list[Decimal]]
Vector = Sequence[Decimal]


def exact_images(scene: StressScene) -> Quantities:
    """Return image, alpha and the gradients of the loss of `loss_weights`, to more digits than float64 holds.

    The formulas of the renderer as they are written in papers, the gradients by central differences, which 60 digits
    leave exact to 40. It takes about a millisecond per pixel, Gaussian and parameter.

    Args:
        scene: few Gaussians in few pixels, with opacities so low that no alpha is clamped and no pixel ends early.

    Returns:
        `quantities.IMAGES`.

    Raises:
        ValueError: if the opacities are too high for that.
    """
    opacities = scene.opacities.tolist()
    if max(opacities) > 0.99 or torch.prod(1.0 - scene.opacities).item() < 1e-4:
        raise ValueError(f"expected Gaussians that neither clamp an alpha nor end a pixel, got opacities {opacities}.")
    height, width = scene.camera.height, scene.camera.width
    with localcontext() as context:
        context.prec = _DIGITS
        tensors: dict[str, Rows] = {
            name: [[Decimal(x) for x in row] for row in getattr(scene, name).view(len(opacities), -1).tolist()]
            for name in PARAMETERS
        }
        pixels = torch.tensor([[float(x) for x in pixel] for pixel in _sums(tensors, scene)], dtype=torch.float64)
        differences = {name: _differences(tensors, name, scene) for name in PARAMETERS}
    picture = pixels.T.reshape(4, height, width)
    gradients = {
        f"d {name}": torch.tensor(x, dtype=torch.float64).view(getattr(scene, name).shape)
        for name, x in differences.items()
    }
    return {"image": picture[:3], "alpha": picture[3], **gradients}


def _differences(tensors: dict[str, Rows], name: str, scene: StressScene) -> list[float]:
    """Return the derivatives of the loss with respect to every number of a tensor."""
    derivatives = []
    for row in tensors[name]:
        for i, x in enumerate(row):
            step = _STEP * max(abs(x), Decimal(1))
            row[i] = x + step
            above = _loss(tensors, scene)
            row[i] = x - step
            derivatives.append(float((above - _loss(tensors, scene)) / (2 * step)))
            row[i] = x
    return derivatives


def _loss(tensors: dict[str, Rows], scene: StressScene) -> Decimal:
    weights = loss_weights(scene.camera).permute(1, 2, 0).reshape(-1, 4).tolist()
    pixels = _sums(tensors, scene)
    return sum((_dot([Decimal(w) for w in row], x) for row, x in zip(weights, pixels, strict=True)), Decimal(0))


def _sums(tensors: dict[str, Rows], scene: StressScene) -> Rows:
    """Return red, green, blue and alpha of every pixel, row by row."""
    splats = sorted(_splats(tensors, scene), key=lambda splat: splat[0])
    behind = [Decimal(x) for x in scene.background.tolist()]
    cut, half = Decimal(1) / 255, Decimal("0.5")
    pixels = []
    for i in range(scene.camera.height):
        for j in range(scene.camera.width):
            light, color = Decimal(1), [Decimal(0)] * 3
            for _, (px, py), (xx, xy, yy), opacity, rgb in splats:
                dx, dy = j + half - px, i + half - py
                distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
                alpha = opacity * (-distance / 2).exp()
                if alpha >= cut:
                    color = [c + light * alpha * x for c, x in zip(color, rgb, strict=True)]
                    light *= 1 - alpha
            pixels.append([*(c + light * b for c, b in zip(color, behind, strict=True)), 1 - light])
    return pixels


def _splats(tensors: dict[str, Rows], scene: StressScene) -> Iterator[tuple[Decimal, Vector, Vector, Decimal, Vector]]:
    """Project the Gaussians: depth, pixel, dilated covariance (xx, xy, yy), opacity and colour of each."""
    camera = scene.camera
    pose = [[Decimal(x) for x in row] for row in camera.world_to_camera.tolist()]
    fx, fy, cx, cy = (Decimal(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    limit_x, limit_y = _MARGIN * camera.width / (2 * fx), _MARGIN * camera.height / (2 * fy)
    for mean, quaternion, scale, (opacity,), color in zip(*(tensors[name] for name in PARAMETERS), strict=True):
        x, y, z = (_dot(row[:3], mean) + row[3] for row in pose[:3])
        if z <= _NEAR:
            continue
        u, v = (max(-limit, min(limit, slope)) for limit, slope in ((limit_x, x / z), (limit_y, y / z)))
        norm = _dot(quaternion, quaternion).sqrt()
        a, b, c, d = (q / norm for q in quaternion)
        axes = (
            (1 - 2 * (c * c + d * d), 2 * (b * c + a * d), 2 * (b * d - a * c)),
            (2 * (b * c - a * d), 1 - 2 * (b * b + d * d), 2 * (c * d + a * b)),
            (2 * (b * d + a * c), 2 * (c * d - a * b), 1 - 2 * (b * b + c * c)),
        )
        halves = []
        for axis, s in zip(axes, scale, strict=True):
            right, down, forward = (s * _dot(row[:3], axis) for row in pose[:3])
            halves.append((fx / z * (right - u * forward), fy / z * (down - v * forward)))
        xx = sum((p * p for p, _ in halves), _DILATION)
        yy = sum((q * q for _, q in halves), _DILATION)
        xy = sum((p * q for p, q in halves), Decimal(0))
        yield z, (fx * x / z + cx, fy * y / z + cy), (xx, xy, yy), opacity, color


def _dot(a: Vector, b: Vector) -> Decimal:
    return sum((x * y for x, y in zip(a, b, strict=True)), Decimal(0))
