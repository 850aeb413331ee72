"""The co-adaptation score as a torchmetrics metric: it resets, syncs over ranks and joins a MetricCollection."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from itertools import count
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAScore, Params
from ca_reg.result import COLUMNS, CASummary, row_of, summary_of, view_position
from ca_reg.types import RenderFn

__all__ = ["CAScoreMetric"]


try:
    from torchmetrics import Metric
except ImportError as error:
    raise ImportError("CAScoreMetric needs torchmetrics: pip install 'ca_reg[torchmetrics]'") from error

_numbers = count()


class CAScoreMetric(Metric):
    """The mean co-adaptation score of the views seen since the last reset, as a torchmetrics metric.

    ``update(opacity, view)`` measures one view, ``forward`` also returns its score, ``compute`` returns the mean over
    views and ranks as a scalar, as Lightning's ``self.log`` and a ``MetricCollection`` expect; ``summary`` returns the
    same mean with its standard error, its reason and the number of views without visible pixels. Such views are left
    out of the mean, which is nan without any others.

    In a collection pass arguments by name, ``collection.update(preds=..., target=..., opacity=..., view=...)``: every
    metric takes those that it knows. A copy of the metric measures the same model, which is not copied. Views that a
    sampler repeats to give all ranks equally many count twice, as in any metric.

    Convention: ``opacity`` is activated, in [0, 1], (N,) or (N, 1), and neither scaled nor dropped.

    Args:
        score: a render callable for the paper's protocol, or a :class:`ca_reg.CAScore` with other settings, such as an
            exact one. The score's own count of views is neither used nor changed.
        kwargs: passed on to ``torchmetrics.Metric``, such as ``process_group``, ``sync_on_compute``.

    Attributes:
        score: the score that measures the views.
        sums: the state, summed over ranks: values, squared standard errors, views, and how many of them have no value
            for each reason; (7,) float64. Not in ``state_dict`` unless ``persistent(True)`` is called.

    Raises:
        TypeError: if ``score`` is neither.

    Example:
        >>> from torchmetrics import MetricCollection
        >>> def render_fn(opacity: Tensor, view: float) -> tuple[Tensor, Tensor]:
        ...     return (view * opacity[:48]).view(3, 4, 4), torch.ones(4, 4)
        >>> more = CAScoreMetric(CAScore(render_fn, samples=9))
        >>> metrics = MetricCollection({"ca": CAScoreMetric(render_fn), "more": more})
        >>> for view in (0.2, 0.4):
        ...     metrics.update(opacity=torch.ones(50), view=view)
        >>> sorted(metrics.compute())
        ['ca', 'more']
        >>> metrics["ca"].summary().views
        2
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    plot_lower_bound = 0.0
    sums: Tensor

    def __init__(self, score: CAScore | RenderFn, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.score = score if isinstance(score, CAScore) else CAScore(score)
        self.add_state("sums", default=torch.zeros(COLUMNS, dtype=torch.float64), dist_reduce_fx="sum")
        # A collection lets metrics share their updates if their states are equal by allclose, as those of small scores
        # are, or empty ones. A number of its own tells a metric apart: two digits in base 4096, as the tolerance is
        # relative.
        digits = torch.tensor(divmod(next(_numbers), 4096), dtype=torch.float64)
        self.add_state("identity", default=digits, dist_reduce_fx="max")

    def forward(self, opacity: Tensor | Params, view: Any, *, index: int | None = None) -> Tensor:
        """Measure one view, count it, and return its score as a scalar; arguments as for :meth:`update`."""
        # The base class resets the metric during the call, and with it the count of updates.
        index = view_position(self.update_count, self.process_group) if index is None else index
        value: Tensor = super().forward(opacity, view, index=index)
        return value

    def update(self, opacity: Tensor | Params, view: Any, *, index: int | None = None) -> None:
        """Measure one view and count it; arguments and errors are those of :meth:`ca_reg.CAScore.update`."""
        index = view_position(self.update_count - 1, self.process_group) if index is None else index
        self.sums = self.sums + row_of(self.score(opacity, view, index=index)).to(self.sums)

    def compute(self) -> Tensor:
        """Return the mean over the views of all ranks, a scalar; on several ranks every rank must call this."""
        return self.sums.new_tensor(summary_of(self.sums, self.score.settings).value)

    def summary(self) -> CASummary:
        """Return the mean with its standard error, reason and counts; on several ranks every rank must call this."""
        with self.sync_context(dist_sync_fn=self.dist_sync_fn, should_sync=self.sync_on_compute):
            return summary_of(self.sums, self.score.settings)

    def plot(self, val: Tensor | Sequence[Tensor] | None = None, ax: Any = None) -> Any:
        """Plot one value or a sequence of them, by default the present mean; return the figure and its axes."""
        return self._plot(val, ax)

    def __deepcopy__(self, memo: dict[int, Any]) -> CAScoreMetric:
        # clone() makes a deep copy, and the render callable may be a method of the model.
        memo[id(self.score)] = self.score
        twin = type(self).__new__(type(self))
        memo[id(self)] = twin
        twin.__setstate__(deepcopy(self.__getstate__(), memo))
        return twin
