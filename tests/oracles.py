"""Slow independent implementations that the package is tested against."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from reference_trainer.camera import Camera


class GaussianScene(NamedTuple):
    """Random Gaussians in front of a camera; every tensor float64."""

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    camera: Camera

    def tensors(self) -> tuple[Tensor, ...]:
        return self[:5]

    def to(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> "GaussianScene":
        return GaussianScene(*(x.to(device, dtype) for x in self[:5]), self.camera.to(device, dtype))


def random_scene(n: int, width: int, height: int, seed: int, *, size: float = 0.08) -> GaussianScene:
    """Draw n Gaussians, some of them behind the camera or outside the picture, seen by a rotated camera."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.3], [-0.2, 0.3, 0]]).double())
    pose[:3, 3] = torch.tensor([0.05, -0.1, 2.0])
    camera = Camera(pose, 1.3 * width, 1.2 * width, 0.45 * width, 0.55 * height, width, height)
    means = uniform(-0.8, 0.8, n, 3)
    means[: n // 10, 2] -= 2.5
    return GaussianScene(
        means=means,
        quaternions=torch.randn(n, 4, generator=g, dtype=torch.float64),
        scales=size * torch.exp(uniform(-1.2, 1.2, n, 3)),
        opacities=uniform(0.02, 0.999, n),
        colors=uniform(0.0, 1.0, n, 3),
        camera=camera,
    )


def brute_force(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, camera: Camera,
    blur: float = 0.3,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite every Gaussian at every pixel, one after the other, straight from the definitions.

    Returns the color sums (C, H, W) and the accumulated alpha (H, W); differentiable by autograd.
    """
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    y, x = torch.meshgrid(
        torch.arange(camera.height, dtype=means.dtype) + 0.5, torch.arange(camera.width, dtype=means.dtype) + 0.5,
        indexing="ij",
    )  # fmt: skip
    pixels = torch.stack([x, y], dim=-1)
    points = means @ rotation.T + shift
    image = means.new_zeros(camera.height, camera.width, colors.shape[1])
    light = means.new_ones(camera.height, camera.width)
    alive = torch.ones(camera.height, camera.width, dtype=torch.bool)
    for i in torch.argsort(points[:, 2]).tolist():
        px, py, pz = points[i]
        if pz <= 0.2:
            continue
        w, qx, qy, qz = quaternions[i] / quaternions[i].norm()
        skew = torch.stack(
            [torch.stack([0 * w, -qz, qy]), torch.stack([qz, 0 * w, -qx]), torch.stack([-qy, qx, 0 * w])]
        )
        orientation = torch.eye(3, dtype=means.dtype) + 2 * w * skew + 2 * skew @ skew
        covariance = orientation @ torch.diag(scales[i] ** 2) @ orientation.T
        u = torch.clamp(px / pz, -1.3 * camera.width / 2 / camera.fx, 1.3 * camera.width / 2 / camera.fx)
        v = torch.clamp(py / pz, -1.3 * camera.height / 2 / camera.fy, 1.3 * camera.height / 2 / camera.fy)
        zero = 0 * pz
        jacobian = torch.stack(
            [torch.stack([camera.fx / pz, zero, -camera.fx * u / pz]),
             torch.stack([zero, camera.fy / pz, -camera.fy * v / pz])]
        )  # fmt: skip
        projected = jacobian @ rotation @ covariance @ rotation.T @ jacobian.T + blur * torch.eye(2, dtype=means.dtype)
        center = torch.stack([camera.fx * px / pz + camera.cx, camera.fy * py / pz + camera.cy])
        offset = pixels - center
        power = -0.5 * ((offset @ torch.linalg.inv(projected)) * offset).sum(-1)
        raw = opacities[i] * torch.exp(power)
        alpha = raw + (raw.clamp(max=0.99) - raw).detach()  # the gradient passes through the clamp
        alpha = torch.where(raw >= 1 / 255, alpha, torch.zeros_like(alpha))
        alive = alive & (light * (1 - alpha) >= 1e-4)
        weight = torch.where(alive, alpha * light, torch.zeros_like(light))
        image = image + weight[..., None] * colors[i]
        light = torch.where(alive, light * (1 - alpha), light)
    return image.permute(2, 0, 1), 1 - light


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """SciPy's real spherical harmonics of unit vectors (N, 3), order m = -l .. l within a band, (N, (degree + 1)^2).

    SciPy has the complex ones, with the Condon-Shortley phase; m < 0 are their imaginary parts.
    """
    from scipy.special import sph_harm_y  # SciPy 1.15 or newer

    x, y, z = directions.numpy().T
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    values = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), polar, azimuth)
            values.append((value.imag if m < 0 else value.real) * (1 if m == 0 else math.sqrt(2)))
    return torch.from_numpy(np.stack(values, 1))


def split_mix(state: int, n: int) -> list[int]:
    """Return n words of SplitMix64 in the arithmetic of whole numbers."""
    word, words = 1 << 64, list[int]()
    for _ in range(n):
        state = (state + 0x9E3779B97F4A7C15) % word
        x = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 % word
        x = (x ^ x >> 27) * 0x94D049BB133111EB % word
        words.append(x ^ x >> 31)
    return words
