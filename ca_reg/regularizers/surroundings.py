"""Dropout at rates that depend on what surrounds a Gaussian: density and geometry, and what other rules share."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from ca_reg._check import Rate, check_count, check_rate
from ca_reg._precision import at_least_single, without_autocast
from ca_reg.neighbors import nearest_neighbors
from ca_reg.regularizer import Params
from ca_reg.regularizers.dropout import IndependentDropout
from ca_reg.schedules import Schedule, refuse_capture

__all__ = [
    "DensityDropout", "GeometryDropout", "RankedDropout", "Refreshed", "SurroundingsDropout", "mean_distances",
    "neighbors_of", "relative_ranks", "surface_variation", "with_own_memory",
]  # fmt: skip

M = TypeVar("M", bound=nn.Module)


class Refreshed(nn.Module):
    """Keeps a measurement of the surroundings between steps, because a neighbor search takes longer than a step.

    A tensor with one row per Gaussian, measured again every ``every`` steps and when their number changes. If the
    step has not advanced it is recomputed unless the very same means come again, unmodified as far as torch knows:
    one object may score several models. ``state_dict`` holds the tensor and its step; a checkpoint without them
    starts afresh. Pruning as many Gaussians as are added goes unnoticed until the next refresh. The capture of a
    CUDA graph, which would never measure again, is refused with a RuntimeError.
    """

    value: Tensor | None
    _seen: tuple[weakref.ref[Tensor], int] | None = None

    def __init__(self, every: int) -> None:
        check_count(every, "every", minimum=1)
        super().__init__()
        self.every = every
        self.since = 0
        self.register_buffer("value", None, persistent=False)

    def forward(self, x: Params, compute: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``compute(means)``, fresh or cached."""
        assert x.means is not None
        refuse_capture("what surrounds the Gaussians at the step")
        means = x.means.detach()
        if self.value is None or not self.holds(x):
            # A value computed at test time may be used in training; autocast would find neighbors in 16 bits.
            with torch.inference_mode(False), without_autocast(means.device):
                self.value, self.since = compute(means), x.step or 0
            self._seen = weakref.ref(x.means), _version(x.means)
        self.value = self.value.to(means.device)
        return self.value

    def holds(self, x: Params) -> bool:
        """Whether the cached value is still valid."""
        assert x.means is not None
        assert self.value is not None
        if len(self.value) != len(x.means):
            return False  # densified or pruned: rows no longer belong to their Gaussians
        if (advanced := (x.step or 0) - self.since) > 0:
            return advanced < self.every  # whether or not torch saw the means change: some optimizers hide it
        return self._seen is not None and self._seen[0]() is x.means and self._seen[1] == _version(x.means)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_seen"}

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        if self.value is not None and self.every > 1:
            destination[prefix + "value"] = self.value
            destination[prefix + "since"] = torch.tensor(self.since)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        self.value, self._seen = state_dict.pop(prefix + "value", None), None
        self.since = int(state_dict.pop(prefix + "since", 0))


def with_own_memory(module: M) -> M:
    """Return a module that shares everything with this one but what it remembers of the surroundings.

    So a score may measure with the regularizer of a training, at whatever step and model, and not change its draws.
    """
    if isinstance(module, Refreshed):
        return Refreshed(1)  # type: ignore[return-value]  # of the model that is scored, not of an earlier one
    if not any(isinstance(part, Refreshed) for part in module.modules()):
        return module
    # Shallow: parameters and schedules stay shared, only the memory is its own.
    twin = copy.copy(module)
    twin._modules = {name: part and with_own_memory(part) for name, part in module._modules.items()}
    return twin


class SurroundingsDropout(IndependentDropout):
    """Base class of dropouts whose rates follow from a measurement of the surroundings, such as the density.

    A subclass says what to measure and how rates follow from it. In training the measurement is refreshed every
    ``every`` steps (:class:`Refreshed`), at test time it is that of the rendered model. The other arguments are those
    of :class:`~ca_reg.IndependentDropout`.
    """

    needs: ClassVar[tuple[str, ...]] = ("means",)

    def __init__(
        self, rate: float | Schedule | None = None, *, every: int, compensate: bool = False, scale: bool = True
    ) -> None:
        super().__init__(rate, compensate=compensate, scale=scale)
        self.trained, self.tested = Refreshed(every), Refreshed(1)

    def measure(self, means: Tensor) -> Tensor:
        """Return the measurement that the rates depend on, one row per Gaussian."""
        raise NotImplementedError

    def rates_from(self, x: Params, look: Callable[[], Tensor]) -> Rate:
        """Return the rates; ``look()`` returns the measurement, and should not be called while the rate is 0."""
        raise NotImplementedError

    def rates(self, x: Params) -> Rate:
        """Return the rates from the measurement of training, which may be cached."""
        return self.rates_from(x, lambda: self.trained(x, self.measure))

    def test_rates(self, x: Params) -> Rate:
        """Return the rates from a measurement of ``x`` itself."""
        return self.rates_from(x, lambda: self.tested(x, self.measure))


class RankedDropout(SurroundingsDropout):
    """Rates between two bounds, linear in the rank of a measurement: the base of density and geometry dropout."""

    bounded = True

    def __init__(
        self,
        low: float = 0.2,
        high: float = 0.5,
        k: int = 3,
        *,
        every: int = 100,
        compensate: bool = False,
        scale: bool = True,
    ) -> None:
        check_rate(low, "low")
        check_rate(high, "high")
        check_count(k, "k", minimum=1)
        super().__init__(every=every, compensate=compensate, scale=scale)
        self.low, self.high, self.k = low, high, k

    def rates_from(self, x: Params, look: Callable[[], Tensor]) -> Rate:
        """Return ``low + (high - low) rank``."""
        return self.low if self.low == self.high else self.low + (self.high - self.low) * look()


def _version(x: Tensor) -> int:
    """Return a tensor's in-place version counter, 0 for an inference tensor, which has none."""
    return 0 if x.is_inference() else x._version


def neighbors_of(means: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return distances and indices of the k nearest neighbors, (N, k) each; of all others if there are fewer."""
    count = min(k, len(means) - 1)
    if count < 1:
        return means.new_zeros(len(means), 0), torch.zeros(len(means), 0, dtype=torch.int64, device=means.device)
    squares, indices = nearest_neighbors(means, count)
    return squares.sqrt_(), indices


def mean_distances(means: Tensor, k: int) -> Tensor:
    """Return the mean distance to the k nearest neighbors, (N,); 0 if there are none."""
    distances, _ = neighbors_of(means, k)
    return distances.sum(1) / max(distances.shape[1], 1)


def relative_ranks(values: Tensor) -> Tensor:
    """Return ranks from 0, the smallest, to 1, (N,), with mean 1/2; equal values share the mean of their ranks.

    An outlier moves the others by at most 1 / (N - 1), where it would dominate ``(x - min) / (max - min)``.

    Example:
        >>> relative_ranks(torch.tensor([5.0, 1.0, 5.0, 1e9, 0.0]))
        tensor([0.6250, 0.2500, 0.6250, 1.0000, 0.0000])
    """
    if len(values) < 2:
        return torch.full_like(values, 0.5)
    ordered, order = values.sort()
    group = torch.zeros_like(order)  # equal values; `unique` would wait for a card
    group[1:] = (ordered[1:] != ordered[:-1]).cumsum(0)
    counts = torch.zeros_like(order).index_add_(0, group, torch.ones_like(order))
    # A group of equal values that ends at rank e and has c members shares the mean rank e - (c + 1) / 2, from 0.
    ranks = (2 * counts.cumsum(0) - counts - 1).to(values.dtype) / (2 * len(values) - 2)
    return torch.empty_like(values).scatter_(0, order, ranks[group])


class DensityDropout(RankedDropout):
    """Drop at rates from ``low``, the sparsest, to ``high``, the densest (paper, appendix, density-based dropout).

    ``p = low + (high - low) rank``, with the rank in [0, 1] of the density, which falls with the mean distance to the k
    nearest neighbors. ``train()``: ``opacity * keep``; ``eval()``: ``opacity * (1 - p)``. The paper gives the rates and
    their linear mapping, but neither ``k`` nor the measure of density; with ranks, no outlier dominates the rates.

    Args:
        low: rate of the sparsest, in [0, 1). The paper uses 0.2.
        high: rate of the densest, in [0, 1). The paper uses 0.5.
        k: number of neighbors; 3DGS initializes its scales from 3.
        every: steps between neighbor searches; by default 3DGS's densification interval.
        compensate: as in :class:`~ca_reg.IndependentDropout`.
        scale: likewise.

    Example:
        >>> import torch
        >>> from ca_reg import Params
        >>> means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [9.0, 0, 0], [99.0, 0, 0]])
        >>> DensityDropout(k=1).rates(Params(torch.ones(5), means=means))
        tensor([0.4250, 0.4250, 0.4250, 0.2750, 0.2000])
    """

    def measure(self, means: Tensor) -> Tensor:
        """Return the rank of the density, (N,)."""
        return relative_ranks(-mean_distances(means, self.k))


EIGEN_CHUNK = 16_384  # matrices; cuSOLVER's batches end at 32k


class GeometryDropout(RankedDropout):
    """Drop at rates from ``low``, on planes, to ``high``, in scattered volumes (paper, geometry-aware dropout).

    ``p = low + (high - low) rank``, with the rank in [0, 1] of :func:`surface_variation`. ``train()``: ``opacity *
    keep``; ``eval()``: ``opacity * (1 - p)``.

    The paper has one sentence about it, "estimate local geometric complexity by computing structural variation among
    each Gaussian's nearest neighbors", without the measure, its direction, the rates or ``k``: here the measure is the
    standard one for point clouds, and the rates are those of the paper's density-based dropout.

    Args:
        low: rate where the surroundings vary least, in [0, 1).
        high: rate where they vary most, in [0, 1).
        k: number of neighbors.
        every: as in :class:`DensityDropout`.
        compensate: likewise.
        scale: likewise.

    Example:
        >>> from ca_reg import Params
        >>> plane = torch.rand(100, 3) * torch.tensor([1.0, 1.0, 0.0])
        >>> cloud = torch.rand(100, 3) + 9.0
        >>> rates = GeometryDropout().rates(Params(torch.ones(200), means=torch.cat([plane, cloud])))
        >>> bool(rates[:100].max() < rates[100:].min())
        True
    """

    def __init__(
        self,
        low: float = 0.2,
        high: float = 0.5,
        k: int = 10,
        *,
        every: int = 100,
        compensate: bool = False,
        scale: bool = True,
    ) -> None:
        super().__init__(low, high, k, every=every, compensate=compensate, scale=scale)

    def measure(self, means: Tensor) -> Tensor:
        """Return the rank of the surface variation, (N,)."""
        return relative_ranks(surface_variation(means, self.k))


def surface_variation(means: Tensor, k: int) -> Tensor:
    """Return the smallest eigenvalue of the covariance of each point (N, 3) and its k neighbors, as a share of all.

    The definition is that of Pauly, Gross and Kobbelt, "Efficient simplification of point-sampled surfaces" (2002). In
    [0, 1/3], (N,): 0 on a plane or a line or if all points coincide, 1/3 if the covariance is isotropic.
    """
    means = at_least_single(means)
    _, indices = neighbors_of(means, k)
    # Sorted by index: Gaussians with the same members then get exactly the same value, and the same rank.
    members = torch.cat([torch.arange(len(means), device=means.device)[:, None], indices], dim=1).sort(dim=1).values
    offsets = means[members] - means[members[:, :1]]
    offsets = offsets - offsets.mean(1, keepdim=True)
    # Relative to the largest offset, so that squares neither vanish nor overflow.
    offsets = offsets / offsets.abs().amax((1, 2), keepdim=True).clamp_min(torch.finfo(means.dtype).tiny)
    with without_autocast(means.device):
        # In chunks, because cuSOLVER refuses larger batches; each matrix is solved by itself, whatever the chunk.
        variances = torch.cat([torch.linalg.eigvalsh(x.mT @ x) for x in torch.split(offsets, EIGEN_CHUNK)])
    return variances[:, 0].clamp_min(0) / variances.sum(1).clamp_min(torch.finfo(means.dtype).eps)
