"""The planes that 2DGS renders beside the picture: depth, alpha, normals and distortion of flat Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render import Rendering, draw
from reference_trainer.rotations import rotation_matrices

__all__ = ["FAR", "NEAR", "surfel_planes"]

NEAR, FAR = 0.2, 100.0  # between which 2DGS maps depths to [0, 1] for its distortion


def surfel_planes(rendering: Rendering, means: Tensor, quaternions: Tensor, camera: Camera) -> Tensor:
    """Return seven planes (7, H, W): depth, alpha, normal (three, in the camera's axes), a second depth, distortion.

    Depth and normal are sums of weight times value, the normals turned to the camera; the distortion is that of 2DGS,
    equation 13, of depths mapped by ``FAR / (FAR - NEAR) (1 - NEAR / z)``. Depths are those of the centers, where 2DGS
    intersects the surfels, and the second one is the mean depth, where 2DGS has the median.

    Args:
        rendering: of flat Gaussians, with depth.
        means: of all Gaussians, world coordinates, shape (N, 3).
        quaternions: likewise, wxyz, shape (N, 4); the third axes are the normals.
        camera: of the rendering.
    """
    splats, alpha, depth = rendering.splats, rendering.alpha, rendering.depth
    assert depth is not None
    pose = camera.world_to_camera.to(means)
    seen, axes = (x.index_select(0, splats.indices) for x in (means, quaternions))
    normals = rotation_matrices(axes)[:, :, 2] @ pose[:3, :3].T
    away = (normals * (seen @ pose[:3, :3].T + pose[:3, 3])).sum(1, keepdim=True) > 0
    mapped = FAR / (FAR - NEAR) * (1 - NEAR / splats.projection.depths)
    first = draw(
        splats._replace(
            colors=torch.where(away, -normals, normals).to(splats.colors),
            projection=splats.projection._replace(depths=mapped),
        ),
        depth=True,
    )
    second = draw(splats._replace(colors=mapped[:, None].square().expand(-1, 3).contiguous()))
    assert first.depth is not None
    distortion = alpha * second.image[0] - first.depth.square()
    mean = depth / torch.where(alpha > 0, alpha, 1.0)
    return torch.stack([depth, alpha, *first.image, mean, distortion])
