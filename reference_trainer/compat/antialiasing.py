"""Antialiasing after Mip-Splatting: another blur than the renderer's, and opacities that compensate for it."""

from __future__ import annotations

from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import DILATION
from reference_trainer.render.splats import Splats
from reference_trainer.render.torch.projection import project

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
