"""FSGS's density control: new Gaussians between those that are far from their neighbors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ca_reg._check import check_count
from ca_reg.neighbors import nearest_neighbors
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import clone, is_large, split

__all__ = ["ProximityDensity"]

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

    Raises:
        TypeError: if ``until`` is no integer.
        ValueError: if one is out of range.
    """

    def __init__(self, until: int = 2_000, distance: float = 5.0, split_distance: float = 10.0) -> None:
        check_count(until, "until", minimum=0, hint=": 0 unpools nothing")
        if not (distance > 0 and split_distance > 0):
            raise ValueError(f"distance and split_distance must be positive, got {distance}, {split_distance}.")
        self.unpool_until, self.distance, self.split_distance = until, distance, split_distance

    def grow(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Clone, split and unpool, in this order: each sees what the previous ones have added."""
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
        squares, neighbors = nearest_neighbors(means, _NEIGHBORS)
        return (squares.mean(1) > distance * self.extent) & is_large(optimizer, self.extent), neighbors


def between(gaussians: Gaussians, selected: Tensor, neighbors: Tensor) -> Gaussians:
    """Return new Gaussians halfway from the selected to each of their neighbors, with the neighbor's size and opacity.

    Args:
        gaussians: all N.
        selected: which are the sources, shape (N,) bool.
        neighbors: of every Gaussian, shape (N, K).

    Example:
        >>> gaussians = Gaussians.from_points(
        ...     torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]), torch.rand(2, 3), torch.tensor([1.0, 3.0]), sh_degree=0
        ... )
        >>> new = between(gaussians, torch.tensor([True, False]), torch.tensor([[1], [0]]))
        >>> new.means.tolist(), new.scales[0, 0].item()
        ([[1.0, 0.0, 0.0]], 3.0)
    """
    sources = gaussians.means[selected].repeat_interleave(neighbors.shape[1], 0)
    new = gaussians[neighbors[selected].flatten()]
    return replace(
        new,
        means=(sources + new.means) / 2,
        quaternions=torch.eye(4).to(new.quaternions)[:1].expand(len(new), -1),
        sh_dc=torch.zeros_like(new.sh_dc),
        sh_rest=torch.zeros_like(new.sh_rest),
    )
