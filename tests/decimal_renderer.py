"""A renderer in decimal arithmetic of 60 digits, for needles so long that float64 itself is in doubt."""

from decimal import Decimal, localcontext

import numpy as np
import torch

from reference_trainer.studies.stability.quantities import PARAMETERS, loss_weights

__all__ = ["exact_images"]

_DIGITS = 60
_STEP = Decimal("1e-20")  # of the central differences, relative: their error is of the order of its square
_NEAR, _DILATION, _MARGIN = Decimal("0.2"), Decimal("0.3"), Decimal("1.3")
_decimals = np.vectorize(Decimal, otypes=[object])


def exact_images(scene):
    """Return `IMAGES` of a `StressScene`, to more digits than float64 holds.

    The formulas of the renderer as they are written in papers, the gradients of the loss of `loss_weights` by central
    differences, which 60 digits leave exact to 40. Few Gaussians in few pixels, with opacities so low that no alpha is
    clamped and no pixel ends early.

    Raises:
        ValueError: if the opacities are too high for that.
    """
    opacities = scene.opacities.tolist()
    if max(opacities) > 0.99 or torch.prod(1.0 - scene.opacities).item() < 1e-4:
        raise ValueError(f"expected Gaussians that neither clamp an alpha nor end a pixel, got opacities {opacities}.")
    weights = _decimals(loss_weights(scene.camera).numpy())
    with localcontext() as context:
        context.prec = _DIGITS
        tensors = {name: _decimals(getattr(scene, name).numpy()) for name in PARAMETERS}
        picture = _picture(tensors, scene)
        gradients = {f"d {name}": _gradient(tensors, name, scene, weights) for name in PARAMETERS}
    found = {"image": picture[:3], "alpha": picture[3], **gradients}
    return {name: torch.from_numpy(x.astype(np.float64)) for name, x in found.items()}


def _gradient(tensors, name, scene, weights):
    """Return the derivatives of the loss with respect to every number of a tensor."""
    x = tensors[name]
    out = np.empty_like(x)
    for i, value in np.ndenumerate(x):
        step = _STEP * max(abs(value), Decimal(1))
        losses = []
        for x[i] in (value + step, value - step):
            losses.append((weights * _picture(tensors, scene)).sum())
        out[i], x[i] = (losses[0] - losses[1]) / (2 * step), value
    return out


def _picture(tensors, scene):
    """Return red, green, blue and alpha, shape (4, H, W)."""
    camera = scene.camera
    pose = _decimals(camera.world_to_camera.numpy())
    fx, fy, cx, cy = map(Decimal, (camera.fx, camera.fy, camera.cx, camera.cy))
    limit_x, limit_y = _MARGIN * camera.width / (2 * fx), _MARGIN * camera.height / (2 * fy)
    columns, rows = (_decimals(np.arange(n) + 0.5) for n in (camera.width, camera.height))
    points = tensors["means"] @ pose[:3, :3].T + pose[:3, 3]
    light = _decimals(np.ones((camera.height, camera.width)))
    color = np.zeros((3, camera.height, camera.width), dtype=object)
    for i in sorted(range(len(points)), key=lambda i: points[i, 2]):
        x, y, z = points[i]
        if z <= _NEAR:
            continue
        u, v = max(-limit_x, min(limit_x, x / z)), max(-limit_y, min(limit_y, y / z))
        q = tensors["quaternions"][i]
        a, b, c, d = q / (q @ q).sqrt()
        rotation = np.array(
            [
                [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
                [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
                [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
            ]
        )
        jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
        half = jacobian @ pose[:3, :3] @ (rotation * tensors["scales"][i])
        (xx, xy), (_, yy) = half @ half.T + _DILATION * np.array([[1, 0], [0, 1]])
        dx, dy = columns[None, :] - (fx * x / z + cx), rows[:, None] - (fy * y / z + cy)
        distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
        alpha = tensors["opacities"][i] * np.exp(-distance / 2)
        alpha = np.where(alpha >= Decimal(1) / 255, alpha, Decimal(0))
        color = color + light * alpha * tensors["colors"][i][:, None, None]
        light = light * (1 - alpha)
    background = _decimals(scene.background.numpy())[:, None, None]
    return np.concatenate([color + light * background, 1 - light[None]])
