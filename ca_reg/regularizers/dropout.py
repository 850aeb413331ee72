"""The paper's Gaussian dropout: the same rate for every Gaussian."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._check import Rate
from ca_reg.params import Draw, Params
from ca_reg.regularizer import Given
from ca_reg.regularizers.independent import IndependentDropout
from ca_reg.schedules import Schedule

__all__ = ["GaussianDropout"]


class GaussianDropout(IndependentDropout):
    """Drop a random subset of Gaussians in training; scale the opacities in evaluation (paper, Gaussian dropout).

    ``train()``: ``opacity * keep``. ``eval()``: ``opacity * (1 - p)``, the mean over all masks. With ``compensate`` the
    survivors are multiplied by ``1 / (1 - p)`` in training instead, and evaluation leaves the opacities as they are.
    The two schemes are not equivalent: compositing is not linear in the opacities, and rasterizers clamp the alpha of
    survivors, so that Gaussians of opacity above ``0.99 (1 - p)`` are more opaque in evaluation than in the mean over
    all masks. The module has no parameters; put it between the activation of the opacities and the rasterizer.

    Dropped Gaussians must leave no trace in density control: pass the radii through
    :meth:`~ca_reg.Regularizer.mask_radii`.

    A draw comes from the global random state, or from a generator given to the call: ``dropout(opacity,
    generator=generator)``. Under ``torch.vmap`` draw the masks outside, and map
    :func:`~ca_reg.functional.apply_dropout` over them.

    Inside ``torch.compile`` one graph serves all steps, even with ``fullgraph=True``, and the next all numbers of
    Gaussians: the values of the opacities are then not checked, and a schedule draws even where its rate is 0. Inside
    ``torch.utils.checkpoint`` draw without ``generator``, or draw outside and pass ``keep``. The same holds for
    :class:`OpacityNoise`.

    Convention: opacities are activated, in [0, 1], (N,) or (N, 1). The first call rejects negative ones as logits.

    Args:
        p: drop rate in [0, 1), or a schedule of it. The paper uses 0.2.
        compensate: scale the survivors in training rather than all opacities in evaluation.

    Attributes:
        keep: the last mask, True where the Gaussian was kept, (N,) bool; None if nothing was dropped.
        p: the rate at the current step.
        step: the training step, set with :meth:`set_step`; a module with a schedule saves it in ``state_dict``.

    Raises:
        TypeError: if ``p`` is neither a number nor callable.
        ValueError: if a constant ``p`` is outside [0, 1); a schedule is checked at each use.

    Example:
        >>> dropout = GaussianDropout(p=0.2)
        >>> opacity = torch.full((5,), 0.5)
        >>> in_training = dropout(opacity)
        >>> torch.equal(in_training, opacity * dropout.keep)
        True
        >>> torch.equal(dropout(opacity, keep=dropout.keep), in_training)  # replay
        True
        >>> dropout.eval()(opacity)
        tensor([0.4000, 0.4000, 0.4000, 0.4000, 0.4000])
    """

    rate_name = "p"

    def __init__(self, p: float | Schedule, *, compensate: bool = False) -> None:
        super().__init__(p, compensate=compensate)

    @property
    def p(self) -> float:
        """The drop rate at the current step."""
        return self._present_rate()

    def forward(  # type: ignore[override]
        self, opacity: Given, *, keep: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Given:
        """Return the opacities to render.

        As :meth:`Regularizer.forward <ca_reg.Regularizer.forward>`; ``keep``, (N,) bool, is an earlier mask to replay
        instead of drawing one, in training only.
        """
        return super().forward(opacity, drawn=None if keep is None else Draw(keep=keep), generator=generator)

    def rates(self, x: Params) -> Rate:
        """Return the rate at the step."""
        return self.rate_at(x.step)
