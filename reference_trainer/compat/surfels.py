"""The planes that 2DGS and GOF render beside the picture: normals, mean depth and distortion of their surfaces."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render import Rendering, rasterize
from reference_trainer.rotations import rotation_matrices

__all__ = ["FAR", "NEAR", "surface_planes"]

NEAR, FAR = 0.2, 100.0  # between which 2DGS maps depths to [0, 1] for its distortion


def surface_planes(
    rendering: Rendering, means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera
) -> dict[str, Tensor]:
    """Return planes: ``normal`` (3, H, W), in the camera's axes, ``mean_depth`` and ``distortion`` (1, H, W).

    The normal of a Gaussian is its shortest axis, turned to the camera; a pixel's is the sum of weight times normal.
    The distortion is that of 2DGS, equation 13, of depths mapped by ``FAR / (FAR - NEAR) (1 - NEAR / z)``. Depths are
    those of the centers, whereas 2DGS intersects the surfels; the mean depth takes the place of 2DGS's median.

    Args:
        rendering: with depth.
        means: of all Gaussians, world coordinates, shape (N, 3).
        quaternions: likewise, wxyz, shape (N, 4).
        scales: likewise, shape (N, 3).
        camera: of the rendering.
    """
    splats, alpha, depth = rendering.splats, rendering.alpha, rendering.depth
    assert depth is not None
    pose = camera.world_to_camera.to(means)
    seen, turned, lengths = (x.index_select(0, splats.indices) for x in (means, quaternions, scales))
    shortest = lengths.argmin(1)[:, None, None].expand(-1, 3, 1)
    normals = rotation_matrices(turned).gather(2, shortest).squeeze(2) @ pose[:3, :3].T
    away = (normals * (seen @ pose[:3, :3].T + pose[:3, 3])).sum(1, keepdim=True) > 0
    mapped = FAR / (FAR - NEAR) * (1 - NEAR / splats.projection.depths)
    mapped = mapped - mapped.detach().mean()  # differences count: near 1, the distortion of a thin wall would cancel
    first = rasterize(
        splats._replace(
            colors=torch.where(away, -normals, normals).to(splats.colors),
            projection=splats.projection._replace(depths=mapped),
        ),
        depth=True,
    )
    second = rasterize(splats._replace(colors=mapped[:, None].square().expand(-1, 3).contiguous()))
    assert first.depth is not None
    distortion = alpha * second.image[0] - first.depth.square()
    mean = depth / torch.where(alpha > 0, alpha, 1.0)
    return {"normal": first.image, "mean_depth": mean[None], "distortion": distortion[None]}
