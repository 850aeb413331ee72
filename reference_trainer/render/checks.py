"""What the renderer refuses: numbers that are not finite, coordinates too large for float32.

A nan would go unnoticed otherwise: a Gaussian whose depth is nan does not lie in front of the
camera, and is culled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from reference_trainer.camera import Camera
from reference_trainer.render.constants import MAX_ROUNDING
from reference_trainer.render.splats import Projected, Projection, Splats

__all__ = [
    "NotFiniteError", "check_projection", "checked_background", "checked_colors", "new_background", "numbers_to_check"
]  # fmt: skip

_finite: MutableMapping[Tensor, int | None] = WeakIdKeyDictionary()
"""Backgrounds that were found to be finite, by their version: to look again would be to wait for a card again."""


class NotFiniteError(ValueError):
    """An input of the renderer, or its projection, is nan or infinite."""


@torch.no_grad()
def numbers_to_check(
    depths: Tensor, opacities: Tensor, projection: Projection, colors: Tensor, camera: Camera,
    background: Tensor | None,
) -> Tensor:  # fmt: skip
    """Return the sum of the projected depths, numbers that are finite if everything is, and the 16 of the pose.

    ``depths`` and ``opacities`` are those of all Gaussians, as a nan among them would decide who is not rendered.
    """
    everything = [depths, opacities, projection.means, projection.covariances, colors]
    norms = torch._foreach_norm(everything if background is None else [*everything, background])
    sums = [x.reshape(1) for x in (projection.depths.sum(), *norms)]
    return torch.cat([*sums, camera.world_to_camera.reshape(16)])


def new_background(background: Tensor | None, device: torch.device) -> Tensor | None:
    """Return a background that can be checked with the numbers of a projection: of one color, on this device, and new.

    The others are None here, and looked at by `checked_background`.
    """
    if background is None or background.is_inference() or background.shape != (3,) or background.device != device:
        return None
    known = not background.is_floating_point() or _finite.get(background) == background._version
    return None if known else background


@torch.no_grad()
def check_projection(
    projected: Projected,
    inputs: Mapping[str, Tensor],
    camera: Camera,
    background: Tensor | None = None,
) -> None:
    """Raise unless all numbers are finite and the world's coordinates not too large.

    Only if the numbers add up to nan or infinity are the inputs (of all Gaussians, by name) examined one by one. Else
    the background, if one is among the numbers, is finite, too.

    Raises:
        NotFiniteError: if an input, which the message names, or a projection is nan or infinite.
        ValueError: if the rounding of the coordinates moves Gaussians by more than `MAX_ROUNDING`.
    """
    projection, colors, numbers = projected.projection, projected.colors, projected.numbers.tolist()
    depth, total, view = numbers[0], sum(numbers[:-16]), numbers[-16:]
    # How far the camera is from the world's origin along each axis: -R^T t.
    far = max(abs(sum(view[4 * row + axis] * view[4 * row + 3] for row in range(3))) for axis in range(3))
    if not math.isfinite(total):
        _refuse((projection.means, projection.covariances, colors), inputs, camera)
    elif background is not None:
        _finite[background] = background._version
    share = far * len(colors) / depth if depth else 0.0  # in mean depths
    rounding = 0.5 * torch.finfo(colors.dtype).eps * share * max(camera.fx, camera.fy)
    if rounding > MAX_ROUNDING:
        raise ValueError(
            f"the camera is {far:.3g} from the world's origin, where {colors.dtype} "
            f"rounds by {rounding:.2g} pixels of this view, and loses small training steps: subtract a common offset, "
            "such as the mean camera position, from the means and from all cameras, or use float64."
        )


def checked_colors(sh: Tensor | None, sh_degree: int | None, colors: Tensor | None) -> tuple[Tensor, int | None]:
    """Return coefficients and their highest band, or colors and None; raise unless exactly one is given, and valid."""
    if (sh is None) == (colors is None):
        raise ValueError("give either sh (N, K, 3) or colors (N, 3), not both and not neither.")
    if sh is None:
        assert colors is not None
        if colors.ndim != 2 or colors.shape[1] != 3:
            raise ValueError(f"colors must have shape (N, 3), got {tuple(colors.shape)}.")
        return colors, None
    if sh.ndim != 3 or sh.shape[2] != 3:
        raise ValueError(f"sh must have shape (N, K, 3), got {tuple(sh.shape)}.")
    degree = math.isqrt(sh.shape[1]) - 1 if sh_degree is None else sh_degree
    if degree not in (0, 1, 2, 3) or sh.shape[1] < (degree + 1) ** 2:
        raise ValueError(
            f"degree {degree}, of at most 3, needs {(degree + 1) ** 2} coefficients, got sh of {tuple(sh.shape)}."
        )
    return sh, degree


def checked_background(background: Tensor | None, splats: Splats, *shapes: tuple[int, ...]) -> Tensor:
    """Return the background, black by default; raise unless it is finite and has one of the shapes."""
    if background is None:
        return splats.colors.new_zeros(3)
    if background.shape not in shapes:
        raise ValueError(f"background must have shape {' or '.join(map(str, shapes))}, got {tuple(background.shape)}.")
    version = None if background.is_inference() else background._version
    if version is None or _finite.get(background) != version:
        if count := int((~background.isfinite()).sum()):
            raise NotFiniteError(
                f"background must be finite, got nan or infinity in {count} of {background.numel()} numbers."
            )
        _finite[background] = version
    return background.to(splats.colors)


def _refuse(results: tuple[Tensor, ...], inputs: Mapping[str, Tensor], camera: Camera) -> None:
    """Raise and say what is not finite; return if only their sum has overflowed."""
    for name, x in inputs.items():
        bad = ~x.isfinite().reshape(x.shape[0], -1).all(1)
        if bool(bad.any()):
            first = int(bad.nonzero()[0])
            raise NotFiniteError(
                f"{name} must be finite, got nan or infinity in {int(bad.sum())} of {x.shape[0]} Gaussians, the first "
                f"is number {first}. If training made them, lower the learning rates."
            )
    if not all(bool(x.isfinite().all()) for x in results):
        raise NotFiniteError(
            f"Gaussians project to nan or infinity, from finite inputs: their scales go up to "
            f"{inputs['scales'].abs().max().item():.3g}, the camera has fx={camera.fx:.3g}, fy={camera.fy:.3g}, "
            f"cx={camera.cx:.3g}, cy={camera.cy:.3g}. If training made them, lower the learning rates."
        )
