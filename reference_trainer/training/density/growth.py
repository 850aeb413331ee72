"""Density control that adds Gaussians by other signs than the gradient: FSGS's and MVGS's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize, pdist

from ca_reg._check import check_count
from ca_reg.neighbors import nearest_neighbors
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.scene import View
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import clone, is_large, split
from reference_trainer.training.randomness import stream

__all__ = ["ProximityDensity", "RayBoxDensity", "ray_box", "worst_region"]

_NEIGHBORS = 3


class ProximityDensity(AdaptiveDensity):
    """`AdaptiveDensity` with FSGS's proximity-guided unpooling (Zhu et al. 2024, Sec. 3.2).

    A Gaussian is sparse if the mean of the *squared* distances to its 3 nearest neighbors exceeds a multiple of the
    scene's extent, and its largest standard deviation exceeds the extent. At every densification sparse ones are split
    as well; before step ``until`` each adds three more: halfway to each neighbor, with the neighbor's opacity and
    scales, no rotation, and zero spherical harmonics, which is gray. Defaults, order and the comparison of a square
    with a length, which depends on the unit of the scene, are the source's (VITA-Group/FSGS a536a64,
    scene/gaussian_model.py, lines 405-490). Its pairs are not: with several sparse Gaussians, it places new ones
    between one and the neighbors of another.

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; neighbors are sought among all.

    Args:
        until: step before which Gaussians are added between others.
        distance: multiple of the extent beyond which sparse Gaussians are unpooled; positive.
        split_distance: multiple of the extent beyond which they are split; positive.
    """

    def __init__(self, until: int = 2_000, distance: float = 5.0, split_distance: float = 10.0) -> None:
        check_count(until, "until", minimum=0, hint=": 0 unpools nothing")
        if not (distance > 0 and split_distance > 0):
            raise ValueError(f"distance and split_distance must be positive, got {distance}, {split_distance}.")
        self.unpool_until, self.distance, self.split_distance = until, distance, split_distance

    def grow(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Clone, split and unpool, in this order: each sees what the previous ones have added."""
        # Clones are appended: the first len(steep) Gaussians are still those that were judged.
        steep, large = self.selected(optimizer), is_large(optimizer, self.large)
        clone(optimizer, steep & ~large)
        sparse = self._sparse(optimizer, self.split_distance)[0]
        sparse[: len(steep)] |= steep & large
        split(optimizer, sparse, generator=self.split_generator(step))
        if step < self.unpool_until:
            sparse, neighbors = self._sparse(optimizer, self.distance)
            optimizer.append(between(optimizer.gaussians.map(torch.Tensor.detach), sparse, neighbors))

    def _sparse(self, optimizer: GaussianOptimizer, distance: float) -> tuple[Tensor, Tensor]:
        """Return which Gaussians are sparse, shape (N,) bool, and the neighbors of all, shape (N, 3)."""
        means = optimizer.gaussians.means.detach()
        if len(means) <= _NEIGHBORS:
            nobody = torch.zeros(len(means), dtype=torch.bool, device=means.device)
            return nobody, nobody.long()[:, None].expand(-1, _NEIGHBORS)
        # Squared distances against a length, as in the source: see the class.
        squares, neighbors = nearest_neighbors(means, _NEIGHBORS)
        return (squares.mean(1) > distance * self.extent) & is_large(optimizer, self.extent), neighbors


def between(gaussians: Gaussians, selected: Tensor, neighbors: Tensor) -> Gaussians:
    """Return new Gaussians halfway from the selected to each of their neighbors, with the neighbor's size and opacity.

    Of all N Gaussians, ``selected`` (N,) bool are the sources; ``neighbors`` (N, K) are those of every Gaussian.

    Example:
        >>> gaussians = Gaussians.from_points(
        ...     torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]), torch.rand(2, 3), torch.tensor([1.0, 3.0]), sh_degree=0
        ... )
        >>> new = between(gaussians, torch.tensor([True, False]), torch.tensor([[1], [0]]))
        >>> new.means.tolist(), new.scales[0, 0].item()
        ([[1.0, 0.0, 0.0]], 3.0)
    """
    # Copies of the neighbors, of which position, orientation and color are replaced.
    sources = gaussians.means[selected].repeat_interleave(neighbors.shape[1], 0)
    new = gaussians[neighbors[selected].flatten()]
    return replace(
        new,
        means=(sources + new.means) / 2,
        quaternions=torch.eye(4).to(new.quaternions)[:1].expand(len(new), -1),
        sh_dc=torch.zeros_like(new.sh_dc),
        sh_rest=torch.zeros_like(new.sh_rest),
    )


class RayBoxDensity(AdaptiveDensity):
    """`AdaptiveDensity` with the cross-ray densification and the threshold of MVGS (Du et al. 2024).

    At every densification a few training views are drawn at random. For each pair of them, rays through the corners
    of their worst regions (`worst_region`) span a box (`ray_box`); all Gaussians inside are cloned too, whatever their
    size. If two of the cameras' positions, normalized to distance 1 from the world's origin, are more than 1 apart,
    ``densify_gradient`` is halved. The source (xiaobiaodu/MVGS ec9b30e, train.py and scene/gaussian_model.py) takes the
    views of the step; here they are rendered anew, which leaves no state.

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; regions are those of the plain model.

    Args:
        views: number of views, at least 2; all, if there are fewer training views.
        height: of a region, pixels, positive.
        width: of a region, pixels, positive.
    """

    def __init__(self, views: int = 3, height: int = 20, width: int = 40) -> None:
        check_count(views, "views", minimum=2, hint=": the rays of one do not meet")
        check_count(height, "height", minimum=1)
        check_count(width, "width", minimum=1)
        self.views, self.height, self.width = views, height, width

    @torch.no_grad()
    def grow(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Clone and split once."""
        order = torch.randperm(len(self.scene.train), generator=stream(self.config.seed, step, "ray_boxes"))
        views = [self.scene.train[i].to(self.device) for i in order[: self.views].tolist()]
        # Cameras more than 1 apart on the unit sphere around the world's origin count as far apart.
        places = normalize(torch.stack([view.camera.position for view in views]), dim=1)
        threshold = self.config.densify_gradient * (0.5 if bool((pdist(places) > 1).any()) else 1.0)
        steep = self.statistics.mean_gradient >= threshold
        large = is_large(optimizer, self.large)
        clone(optimizer, (steep & ~large) | self._inside(optimizer, views, step))
        split(optimizer, steep & large, generator=self.split_generator(step))

    def _inside(self, optimizer: GaussianOptimizer, views: Sequence[View], step: int) -> Tensor:
        """Return which Gaussians are in the box of any two views, shape (N,) bool."""
        gaussians = optimizer.gaussians.map(torch.Tensor.detach)
        background, degree = self.scene.background.to(self.device), self.config.sh_degree_at(step)
        regions = []
        for view in views:
            image = render_gaussians(gaussians, view.camera, background, sh_degree=degree).image
            error = (image - view.image).abs().mean(0)
            regions.append((view.camera, worst_region(error, self.height, self.width)))
        inside = torch.zeros(len(gaussians), dtype=torch.bool, device=self.device)
        for (one, corners), (other, others) in combinations(regions, 2):
            if (box := ray_box(one, corners, other, others)) is not None:
                inside |= ((gaussians.means > box[0]) & (gaussians.means < box[1])).all(1)
        return inside


def worst_region(error: Tensor, height: int, width: int) -> Tensor:
    """Return the corners of the region of a picture (H, W) with the largest mean; the first of equal ones.

    Regions tile the picture from the upper left, without its last row and column; one that would be larger is cut to
    that size. Returned are the centers of the pixels at the corners, (x, y): upper left and right, lower left and
    right, (4, 2); the right and lower ones lie one pixel outside the region.

    Example:
        >>> error = torch.zeros(9, 9)
        >>> error[3, 7] = 1
        >>> worst_region(error, 2, 4).tolist()
        [[4.5, 2.5], [8.5, 2.5], [4.5, 4.5], [8.5, 4.5]]
    """
    height, width = min(height, error.shape[0] - 1), min(width, error.shape[1] - 1)
    means = avg_pool2d(error[None, :-1, :-1], (height, width), stride=(height, width))[0]
    row, column = divmod(int(means.flatten().argmax()), means.shape[1])
    left, top = column * width + 0.5, row * height + 0.5
    right, bottom = left + width, top + height
    return error.new_tensor([[left, top], [right, top], [left, bottom], [right, bottom]])


def ray_box(one: Camera, corners: Tensor, other: Camera, others: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the box around the points where the rays of two cameras come closest, or None if two are parallel.

    The rays go through pixels (M, 2) of either camera, in the same order. A point is the middle of the shortest segment
    between two rays' lines, even if it lies behind a camera; the box is given by its lower and upper corner in the
    world, (3,) each.

    Example:
        >>> from reference_trainer.camera import Camera
        >>> pose = torch.eye(4)
        >>> pose[0, 3] = -1.0
        >>> left, right = Camera(torch.eye(4), 10, 10, 5, 5, 10, 10), Camera(pose, 10, 10, 5, 5, 10, 10)
        >>> [x.tolist() for x in ray_box(left, torch.tensor([[10.0, 5.0]]), right, torch.tensor([[5.0, 5.0]]))]
        [[1.0, 0.0, 2.0], [1.0, 0.0, 2.0]]
    """
    first, second = one.position, other.position
    along = normalize(one.lift(corners, torch.ones_like(corners[:, 0])) - first, dim=1)
    across = normalize(other.lift(others, torch.ones_like(others[:, 0])) - second, dim=1)
    # The shortest segment between two lines is along their common normal. With n = along x across,
    # the parameters of its ends are ((q - p) x across) . n / n^2 and ((q - p) x along) . n / n^2.
    normal = torch.linalg.cross(along, across)
    squared = normal.square().sum(1)
    if bool((squared < 1e-12).any()):
        return None
    between = (second - first).expand_as(along)
    t = (torch.linalg.cross(between, across) * normal).sum(1) / squared
    s = (torch.linalg.cross(between, along) * normal).sum(1) / squared
    points = (first + t[:, None] * along + second + s[:, None] * across) / 2
    low, high = points.aminmax(dim=0)
    return low, high
