"""Opacities that make up for the blur that the renderer adds to every splat: antialiasing after Mip-Splatting."""

from __future__ import annotations

from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION
from reference_trainer.render.eager.projection import project
from reference_trainer.render.splats import Splats

__all__ = ["antialiased"]


def antialiased(
    splats: Splats, means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera, *, floor: float
) -> Splats:
    """Lower the opacities of splats by the root of the share of their area that they had before `DILATION`.

    The Gaussians are those that the M splats were made of: world coordinates (N, 3), wxyz (N, 4), standard deviations
    (N, 3). The share (Mip-Splatting, equation 9) is at least ``floor``, which is above 0: the root has a slope.
    """
    means, quaternions, scales = (x.index_select(0, splats.indices) for x in (means, quaternions, scales))
    ellipses = project(means, quaternions, scales, camera.to(means.device, means.dtype))
    xx, xy, yy = ellipses.covariances.unbind(-1)
    before = (xx - DILATION) * (yy - DILATION) - xy * xy
    share = (before / (xx * yy - xy * xy)).clamp_min(floor)
    return splats.engine.masked(splats, splats.opacities * share.sqrt())
