"""Another blur than the renderer's, and opacities that make up for it: antialiasing after Mip-Splatting."""

from __future__ import annotations

from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION
from reference_trainer.render.eager.projection import project
from reference_trainer.render.splats import Splats

__all__ = ["filtered"]


def filtered(
    splats: Splats,
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    camera: Camera,
    *,
    blur: float = DILATION,
    floor: float | None,
) -> Splats:
    """Blur splats by ``blur`` in the place of `DILATION`, square pixels, and lower their opacities for it.

    The Gaussians are those that the M splats were made of: world coordinates (N, 3), wxyz (N, 4), standard deviations
    (N, 3). Opacities are multiplied by the root of the share of its area that a splat had before it was blurred
    (Mip-Splatting, equation 9), at least ``floor``, above 0: the root has a slope. None leaves them as they are.

    Raises:
        ValueError: if ``blur`` is negative or above `DILATION`: the tiles were chosen for that.
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
    xx, xy, yy = ellipses.covariances.unbind(-1)
    before = (xx - blur) * (yy - blur) - xy * xy
    share = (before / (xx * yy - xy * xy)).clamp_min(floor)
    return splats.engine.masked(splats, splats.opacities * share.sqrt())
