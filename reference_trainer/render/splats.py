"""What engines are, and what they produce: projected Gaussians, tile lists, and rendered views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import TILE

__all__ = [
    "Engine",
    "MomentImages",
    "Projected",
    "Projection",
    "Rendering",
    "Splats",
    "TileCounts",
    "TileLists",
    "ViewSplats",
]


class Projection(NamedTuple):
    """Projected Gaussians.

    The inverse 2D covariance is kept as its triangular factor: the squared Mahalanobis distance of
    an offset (dx, dy) is ``(l11 dx + l21 dy)^2 + (l22 dy)^2``. The inverse covariance of a needle
    at 45 degrees has large entries that cancel; its factor does not cancel, so float32 is enough.
    """

    means: Tensor  # pixel coordinates, shape (M, 2)
    factors: Tensor  # ``(l11, l21, l22)``, shape (M, 3)
    covariances: Tensor  # ``(xx, xy, yy)`` of the dilated 2D covariance, square pixels, shape (M, 3)
    depths: Tensor  # along the camera's z axis, shape (M,)


class TileCounts(NamedTuple):
    """How many tiles of the image Gaussians touch, counted with their projection to wait for a card only once."""

    each: Tensor  # shape (M,), int32
    touched: Tensor  # whether it is above 0, (M,) bool
    numbers: Tensor  # of the engine's kernels, on the card
    total: int = 0  # sum over the Gaussians


class Projected(NamedTuple):
    """M of N Gaussians that lie in view of a camera, projected and colored."""

    indices: Tensor  # which of the N, in order, (M,)
    projection: Projection
    opacities: Tensor  # activated, (M,)
    colors: Tensor  # towards this camera, (M, 3)
    numbers: Tensor  # what `check_projection` reads
    counts: TileCounts | None = None  # of the engine triton


@dataclass(frozen=True)
class TileLists:
    """For every tile the Gaussians that can reach `MIN_ALPHA` at one of its pixels, nearest first.

    Args:
        width: image width, pixels.
        height: image height, pixels.
        starts: where each tile's list starts, row by row over the image, and where the last ends,
            shape (tiles + 1,).
        gaussians: the indices of the listed Gaussians, tile after tile, shape (P,).
        touched: whether a Gaussian is in any list, shape (M,) bool.
        slots: a unique number for every entry, consecutive for each Gaussian, shape (P,); the loops
            need them.
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

    def only(self, keep: Tensor) -> TileLists:
        """Return the lists of some Gaussians, ``keep`` (M,) bool; slots and offsets are lost."""
        stays = keep[self.gaussians]
        starts = torch.nn.functional.pad(stays.cumsum(0), (1, 0))[self.starts]
        gaussians, touched = self.gaussians[stays], self.touched & keep
        return replace(self, starts=starts, gaussians=gaussians, touched=touched, slots=None, offsets=None)


class Splats(NamedTuple):
    """Gaussians made ready for one camera: M of N are projected, colored, and listed per tile."""

    indices: Tensor  # which of the N, (M,)
    projection: Projection
    opacities: Tensor  # activated, (M,)
    colors: Tensor  # towards this camera, (M, 3)
    lists: TileLists
    engine: Engine  # what made them, and renders them

    @property
    def means(self) -> Tensor:
        """Projected centers, see `ViewSplats`."""
        return self.projection.means

    @property
    def touched(self) -> Tensor:
        """Which of the M may have reached a pixel, see `ViewSplats`."""
        return self.lists.touched

    def to_all(self, values: Tensor, count: int) -> Tensor:
        """Return what the M have, (M, ...), in a table of all N = ``count``, (N, ...), zeros for the others."""
        return values.new_zeros(count, *values.shape[1:]).index_copy(0, self.indices, values)


class ViewSplats(Protocol):
    """What density control reads of a render, whichever renderer made it."""

    @property
    def indices(self) -> Tensor:
        """Which of the N Gaussians lie in view, shape (M,)."""

    @property
    def means(self) -> Tensor:
        """Their projected centers, pixels, which keep their gradient, shape (M, 2)."""

    @property
    def touched(self) -> Tensor:
        """Which of them were rendered, shape (M,) bool."""


class Rendering(NamedTuple):
    """A rendered view."""

    image: Tensor  # colors over the background, not clamped, shape (3, H, W)
    alpha: Tensor  # accumulated alpha, shape (H, W)
    depth: Tensor | None  # sum of weight times camera depth, not divided by alpha, shape (H, W); None unless asked for
    splats: Splats  # what was rendered. ``splats.projection.means`` keeps its gradient (pixels) for densification


class MomentImages(NamedTuple):
    """Moments of every pixel over the random factors."""

    mean: Tensor  # expected colors over the background, (3, H, W)
    variance: Tensor  # of the colors, at least 0, (3, H, W)
    alpha_mean: Tensor  # expected accumulated alpha, (H, W)


class Engine(Protocol):
    """What renders: turns Gaussians into images, and into the exact moments of images.

    All tensors of a call share one dtype and one device, and have been checked
    (`reference_trainer.render.renderer`); results are differentiable unless said otherwise. A new
    engine is to be added to `reference_trainer.render.engine`.
    """

    name: str

    def project(
        self, inputs: dict[str, Tensor], camera: Camera, degree: int | None, background: Tensor | None = None
    ) -> Projected:
        """Project the Gaussians that lie in view and evaluate their colors.

        These are the ones beyond `NEAR_PLANE` with an opacity of at least `MIN_ALPHA`. The inputs,
        by name, are means (N, 3), quaternions (N, 4), scales (N, 3), opacities (N,), and either sh
        (N, K, 3), used up to band ``degree``, or colors (N, 3), whose ``degree`` is None. A
        background (3,) is checked with the numbers.
        """

    def bin(self, projected: Projected, width: int, height: int) -> TileLists:
        """List the Gaussians of every tile.

        A Gaussian belongs to a tile if the ellipse on which its alpha is `MIN_ALPHA` meets the
        rectangle spanned by the tile's pixel centers. The test is exact: within a row of tiles, an
        ellipse covers an interval of columns.
        """

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Return the splats with lower opacities (M,), reusing projection and lists.

        None may be higher than before: the lists would be too short. Splats below `MIN_ALPHA` cost
        nothing.
        """

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Composite splats front to back over a background (3,).

        Returns image (3, H, W), alpha (H, W), and depth (H, W) if asked for.
        """

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Composite K images at once, without a graph; what their masks share is computed once.

        The opacities (K, M) are as in `masked`. Returns images (K, 3, H, W) and alphas (K, H, W).
        """

    def absolute_gradients(self, splats: Splats, rendered: Tensor, gradient: Tensor) -> Tensor:
        """Sum the absolute values of each pixel's gradient of the centers (AbsGS), (M, 2).

        Without a graph. ``rendered`` (5, H, W) holds colors and depth over black and the accumulated
        alpha, and ``gradient`` that of a loss with respect to it.
        """

    def moments(self, splats: Splats, multiplier: Tensor, background: Tensor) -> MomentImages:
        """Return mean and variance of every pixel under random factors on the alphas.

        ``multiplier`` (M, 2) holds mean and variance of every splat's factor, the background is (3,
        H, W).
        """

    def shares(self, splats: Splats, multiplier: Tensor, background: Tensor, weights: Tensor) -> Tensor:
        """Return every splat's share of the variance, weighted by pixel (H, W); (M,), float64."""
