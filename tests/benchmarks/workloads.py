"""Three standard workloads of growing size, the same on every machine."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.torch.projection import project

__all__ = ["PARAMETERS", "WORKLOADS", "Workload", "WorkloadSpec", "covered_pairs"]

PARAMETERS = ("means", "quaternions", "scales", "opacities", "colors")
"""What is rendered and what gradients are asked for, by the names that the renderer gives them."""

_SEED = 1234
_MIN_ALPHA = 1 / 255
_DISTANCE = 2.0  # from the camera to the center of the cube
_YAW, _PITCH = 10.0, -7.0  # of the camera, degrees
_FOCAL = 2.0  # in image widths
_SPREAD = 3.0  # scales lie between the base scale divided and multiplied by this


@dataclass(frozen=True)
class Workload:
    """Gaussians, a camera, and a picture to fit.

    Args:
        means: world coordinates, shape (N, 3).
        quaternions: wxyz, normalized, shape (N, 4).
        scales: standard deviations, shape (N, 3).
        opacities: activated, shape (N,).
        colors: RGB in [0, 1], shape (N, 3).
        target: of the loss, a constant, shape (3, H, W).
        camera: the view.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    target: Tensor
    camera: Camera

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The five tensors of the Gaussians by name."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Workload:
        """Return the workload on another device or in another dtype."""
        return replace(self, **{x.name: getattr(self, x.name).to(device=device, dtype=dtype) for x in fields(self)})


@dataclass(frozen=True)
class WorkloadSpec:
    """The recipe of a workload: random Gaussians in the unit cube, seen from outside, before black.

    Means are uniform in the cube around the origin, orientations isotropic, scales log-uniform over a factor of 9 and
    independent per axis, opacities uniform in [0.1, 0.9], colors and target uniform in [0, 1].

    Convention: OpenCV camera, turned by 10 degrees in yaw and -7 in pitch, 2 in front of the center, focal length of
    two image widths. Drawn in float64 by numpy's PCG64 in the order means, quaternions, scales, opacities, colors,
    target (H, W, 3), then rounded to float32.

    Args:
        gaussians: number N of them.
        width: of the picture, pixels.
        height: of the picture, pixels.
        base_scale: geometric mean of the scales. Those of `WORKLOADS` are calibrated once, by bisection in its
            logarithm, so that 45 Gaussians reach an alpha of 1/255 at the mean pixel.

    Example:
        >>> workload = WorkloadSpec(100, 32, 24, 0.05).make()
        >>> workload.means.shape, workload.target.shape
        (torch.Size([100, 3]), torch.Size([3, 24, 32]))
    """

    gaussians: int
    width: int
    height: int
    base_scale: float

    def make(self) -> Workload:
        """Draw the workload, float32 on the CPU."""
        rng, n = np.random.default_rng(_SEED), self.gaussians
        means = rng.uniform(-0.5, 0.5, (n, 3))
        quaternions = rng.normal(size=(n, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        scales = self.base_scale * np.exp(rng.uniform(-np.log(_SPREAD), np.log(_SPREAD), (n, 3)))
        opacities = rng.uniform(0.1, 0.9, n)
        colors = rng.uniform(0.0, 1.0, (n, 3))
        target = rng.uniform(0.0, 1.0, (self.height, self.width, 3))
        focal = _FOCAL * self.width
        return Workload(
            means=_single(means),
            quaternions=_single(quaternions),
            scales=_single(scales),
            opacities=_single(opacities),
            colors=_single(colors),
            target=_single(target.transpose(2, 0, 1)),
            camera=Camera(_single(_pose()), focal, focal, self.width / 2, self.height / 2, self.width, self.height),
        )


WORKLOADS: dict[str, WorkloadSpec] = {
    "small": WorkloadSpec(2_000, 128, 128, 0.02327788147175662),
    "medium": WorkloadSpec(10_000, 256, 256, 0.010006852535217017),
    "large": WorkloadSpec(50_000, 512, 384, 0.004346772307329407),
}
"""The workloads by name."""


@torch.no_grad()
def covered_pairs(workload: Workload) -> int:
    """Count the pairs of a pixel and a Gaussian whose alpha there is at least 1/255, hidden ones included.

    Exact in float64 up to pairs on the edge: an ellipse covers an interval of every row of pixels. All Gaussians must
    lie in front of the camera.

    Example:
        >>> round(covered_pairs(WORKLOADS["small"].make()) / (128 * 128))
        45
    """
    precise = workload.to("cpu", torch.float64)
    camera = precise.camera
    projection = project(precise.means, precise.quaternions, precise.scales, camera)
    (x, y), (l11, l21, l22) = projection.means.unbind(1), projection.factors.unbind(1)
    squared_radius = 2 * torch.log(precise.opacities / _MIN_ALPHA).clamp(min=0)
    reach = squared_radius.sqrt() / l22
    first = torch.ceil(y - reach - 0.5).clamp(min=0)
    rows = (torch.floor(y + reach - 0.5).clamp(max=camera.height - 1) - first + 1).clamp(min=0).long()
    of = torch.repeat_interleave(rows)
    row = first[of] + torch.arange(of.shape[0]) - (rows.cumsum(0) - rows)[of]
    dy = row + 0.5 - y[of]
    half = (squared_radius[of] - (l22[of] * dy) ** 2).clamp(min=0).sqrt() / l11[of]
    middle = x[of] - l21[of] / l11[of] * dy
    begin = torch.ceil(middle - half - 0.5).clamp(min=0)
    end = torch.floor(middle + half - 0.5).clamp(max=camera.width - 1)
    return int((end - begin + 1).clamp(min=0).sum().item())


def _pose() -> NDArray[np.float64]:
    """Return the view matrix: yaw, then pitch, then the step back."""
    yaw, pitch = np.deg2rad(_YAW), np.deg2rad(_PITCH)
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    pose = np.eye(4)
    pose[:3, :3] = tilt @ turn
    pose[2, 3] = _DISTANCE
    return pose


def _single(array: NDArray[np.float64]) -> Tensor:
    """Round to float32."""
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
