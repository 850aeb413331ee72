"""What rasterizers of the INRIA family compute beside the picture, and blurs other than the renderer's."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render import Rendering, rasterize
from reference_trainer.render.constants import DILATION
from reference_trainer.render.splats import Splats
from reference_trainer.render.torch.compositing import (
    PIXELS,
    blend_weights,
    blocks,
    geometry_rows,
    pad_entries,
    pixel_offsets,
    tile,
    untile,
)
from reference_trainer.render.torch.projection import project
from reference_trainer.rotations import rotation_matrices

__all__ = ["FAR", "NEAR", "contributions", "filtered", "heaviest", "surface_planes"]


def filtered(
    splats: Splats,
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    camera: Camera,
    *,
    blur: float,
    floor: float | None,
) -> Splats:
    """Blur splats by ``blur`` instead of `DILATION`, in square pixels, and lower their opacities accordingly.

    The Gaussians are those that the M splats were made of: world coordinates (N, 3), wxyz (N, 4), standard deviations
    (N, 3). Opacities are multiplied by the root of the ratio of the covariance's determinants before and after the blur
    (Mip-Splatting, equation 9). The ratio is at least ``floor``, above 0, as the root's slope is infinite there; a
    floor of None leaves opacities as they are.

    Raises:
        ValueError: if ``blur`` is negative or above `DILATION`, for which the tile lists were made.
    """
    if not 0 <= blur <= DILATION:
        raise ValueError(
            f"the blur of a splat (kernel_size, eps2d) must be in [0, {DILATION}] square pixels for the stand-in, got "
            f"{blur}."
        )
    means, quaternions, scales = (x.index_select(0, splats.indices) for x in (means, quaternions, scales))
    ellipses = project(means, quaternions, scales, camera.to(means.device, means.dtype), dilation=blur)
    if blur != DILATION:
        own = {"factors": ellipses.factors, "covariances": ellipses.covariances}
        splats = splats._replace(projection=splats.projection._replace(**own))
    if floor is None:
        return splats
    # det C / det(C + blur I) as 1 - blur (trace C + blur) / det(C + blur I): xx yy - xy^2 would cancel for needles.
    (xx, _, yy), (l11, _, l22) = ellipses.covariances.unbind(-1), ellipses.factors.unbind(-1)
    share = (1 - blur * (xx + yy - blur) * (l11 * l22).square()).clamp_min(floor)
    return splats.engine.masked(splats, splats.opacities * share.sqrt())


@torch.no_grad()
def contributions(splats: Splats, image: Tensor) -> Tensor:
    """Sum over the pixels at which a splat is rendered: an image (H, W), ones, its blend weights, and its distances.

    The sums are (4, M); distances are from the splat's center to the pixel, in pixels.
    """
    rows = pad_entries(geometry_rows(splats))
    sums = rows.new_zeros(4, rows.shape[1])
    inside = tile(torch.stack([image.to(rows), torch.ones_like(image).to(rows)]), splats.lists)
    pixels = pixel_offsets(rows)
    for block in blocks(splats.lists, rows.device):
        entries = rows[:, block.gaussians]
        weights = blend_weights(block.alphas(entries))
        covered = (weights > 0).to(weights)
        x, y = entries[:2, :, None]
        dx, dy = (pixels[i] + block.centers[i][..., None] - center for i, center in enumerate((x, y)))
        values, ones = inside[block.tiles], inside[block.tiles][:, 1:]
        found = torch.cat([values @ covered, ones @ weights, ones @ (covered * torch.hypot(dx, dy))], dim=1)
        sums.index_add_(1, block.gaussians.flatten(), found.transpose(0, 1).flatten(1))
    return sums[:, :-1]


NEAR, FAR = 0.2, 100.0  # between which 2DGS maps depths to [0, 1] for its distortion


@torch.no_grad()
def heaviest(splats: Splats) -> tuple[Tensor, Tensor]:
    """Return which of the N Gaussians has the largest blend weight at every pixel, -1 for none, and it: (H, W)."""
    rows = pad_entries(geometry_rows(splats))
    lists = splats.lists
    # Indices share a table with the weights, so that one pass reorders both: float32 counts splats exactly to 2^24.
    found = rows.new_zeros(lists.rows * lists.columns, 2, PIXELS)
    found[:, 0] = -1
    for block in blocks(lists, rows.device):
        weights, place = blend_weights(block.alphas(rows[:, block.gaussians])).max(-1)
        index = block.gaussians.gather(1, place.flatten(1)).view_as(place).to(weights)
        found[block.tiles] = torch.stack([torch.where(weights > 0, index, -1.0), weights], dim=1)
    index, weight = untile(found, lists)
    # From the M splats to the N Gaussians; -1, for no splat, finds the appended -1.
    return torch.nn.functional.pad(splats.indices, (0, 1), value=-1)[index.long()], weight


def surface_planes(
    rendering: Rendering, means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera
) -> dict[str, Tensor]:
    """Return planes: ``normal`` (3, H, W), in the camera's axes, ``mean_depth`` and ``distortion`` (1, H, W).

    The normal of a Gaussian is its shortest axis, turned to the camera; a pixel's is the sum of weight times normal.
    The distortion is that of 2DGS, equation 13, of depths mapped by ``FAR / (FAR - NEAR) (1 - NEAR / z)``. Depths are
    those of the centers, whereas 2DGS intersects the surfels; the mean depth takes the place of 2DGS's median.

    The rendering has depth; means (N, 3), quaternions (N, 4) and scales (N, 3) are those of all Gaussians.
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
