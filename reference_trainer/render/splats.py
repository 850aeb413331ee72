"""What the engines produce: projected Gaussians, tile lists, and rendered views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from reference_trainer.render.constants import TILE

if TYPE_CHECKING:
    from reference_trainer.render.engine import Engine

__all__ = ["MomentImages", "Projection", "Rendering", "Splats", "TileLists"]


class Projection(NamedTuple):
    """Projected Gaussians.

    The inverse 2D covariance is kept as its triangular factor: the squared Mahalanobis distance of an offset (dx, dy)
    is ``(l11 dx + l21 dy)^2 + (l22 dy)^2``. The inverse covariance of a needle at 45 degrees has large entries that
    cancel; its factor does not cancel, so float32 is enough.

    Args:
        means: pixel coordinates, shape (M, 2).
        factors: ``(l11, l21, l22)``, shape (M, 3).
        covariances: ``(xx, xy, yy)`` of the dilated 2D covariance, square pixels, shape (M, 3).
        depths: along the camera's z axis, shape (M,).
    """

    means: Tensor
    factors: Tensor
    covariances: Tensor
    depths: Tensor


@dataclass(frozen=True)
class TileLists:
    """For every tile the Gaussians that can reach `MIN_ALPHA` at one of its pixels, nearest first.

    Args:
        width: image width, pixels.
        height: image height, pixels.
        starts: where each tile's list starts, row by row over the image, and where the last ends, shape (tiles + 1,).
        gaussians: the indices of the listed Gaussians, tile after tile, shape (P,).
        touched: whether a Gaussian is in any list, shape (M,) bool.
        slots: a unique number for every entry, consecutive for each Gaussian, shape (P,); the loops need them.
        offsets: each Gaussian's first slot, and the number of all, shape (M + 1,); likewise.
    """

    width: int
    height: int
    starts: Tensor
    gaussians: Tensor
    touched: Tensor
    slots: Tensor | None = None
    offsets: Tensor | None = None

    @property
    def columns(self) -> int:
        """Tiles in a row of the image."""
        return -(-self.width // TILE)

    @property
    def rows(self) -> int:
        """Tiles in a column of the image."""
        return -(-self.height // TILE)

    @property
    def lengths(self) -> Tensor:
        """List length of each tile, shape (tiles,)."""
        return self.starts.diff()

    def padded(self, image: Tensor) -> Tensor:
        """Return an image (..., H, W) padded with zeros to whole tiles."""
        missing = (0, TILE * self.columns - self.width, 0, TILE * self.rows - self.height)
        return torch.nn.functional.pad(image, missing) if any(missing) else image

    def cut(self, image: Tensor) -> Tensor:
        """Return the part (..., H, W) of an image of whole tiles."""
        return image[..., : self.height, : self.width]

    def only(self, kept: Tensor) -> TileLists:
        """Return the lists without Gaussians that are not kept, (M,) bool, and without slots and offsets."""
        stays = kept[self.gaussians]
        starts = torch.nn.functional.pad(stays.cumsum(0), (1, 0))[self.starts]
        gaussians, touched = self.gaussians[stays], self.touched & kept
        return replace(self, starts=starts, gaussians=gaussians, touched=touched, slots=None, offsets=None)


class Splats(NamedTuple):
    """Gaussians made ready for one camera: M of N are projected, colored, and listed per tile."""

    indices: Tensor  # which of the N, (M,)
    projection: Projection
    opacities: Tensor  # activated, (M,)
    colors: Tensor  # towards this camera, (M, 3)
    lists: TileLists
    engine: Engine  # what made them, and draws them


class Rendering(NamedTuple):
    """A rendered view.

    Args:
        image: colors over the background, not clamped, shape (3, H, W).
        alpha: accumulated alpha, shape (H, W).
        depth: sum of weight times camera depth, not divided by alpha, shape (H, W); None unless asked for.
        splats: what was drawn. ``splats.projection.means`` keeps its gradient (pixels) for densification.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor | None
    splats: Splats


class MomentImages(NamedTuple):
    """Moments of every pixel over the random factors."""

    mean: Tensor  # expected colors over the background, (3, H, W)
    variance: Tensor  # of the colors, at least 0, (3, H, W)
    alpha_mean: Tensor  # expected accumulated alpha, (H, W)
