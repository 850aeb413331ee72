"""The paper's concrete dropout: soft masks whose rates are learned, one per Gaussian."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

from ca_reg._check import check_finite
from ca_reg.params import Params
from ca_reg.regularizer import Learned
from ca_reg.regularizers.binary_concrete import BinaryConcrete

__all__ = ["ConcreteDropout"]


class ConcreteDropout(BinaryConcrete):
    """Multiply opacities by ``1 - z``, z binary concrete with a rate per Gaussian that is learned (paper, appendix).

    ``train()``: ``opacity * (1 - z)``, ``z = sigmoid((logit p + logit u) / 0.1)`` with ``u ~ U(0, 1)``. ``eval()``: the
    opacity times the mean of ``1 - z``; the paper does not say what it renders. The logit of p is a parameter of the
    Gaussian, ``Params.learned["dropout_logits"]``, cloned, split, pruned and saved with it. The exact multiplier is
    differentiable in it.

    Nothing keeps the rates up: a loss that only fits the photographs lowers them, and the paper finds more
    co-adaptation than without a regularizer (test CA 0.0053 against 0.0020).

    Args:
        p: initial rate of each Gaussian, in (0, 1). The paper does not give it; Gal et al. 2017 start at 0.1.
        rate: learning rate of the logits. The paper does not give it; the default is that of the opacity logits.
        temperature: 0.1 in the paper.

    Raises:
        TypeError: if ``rate`` is not a number.
        ValueError: if an argument is out of range.

    Example:
        >>> import torch
        >>> dropout = ConcreteDropout(p=0.1)
        >>> x = Params(torch.full((3,), 0.5), learned={"dropout_logits": torch.tensor([-2.2, 0.0, 2.2])})
        >>> bool((dropout(x).opacities < 0.5).any())
        True
        >>> dropout.eval()(x).opacities
        tensor([0.4495, 0.2500, 0.0505])
    """

    def __init__(self, p: float = 0.1, rate: float = 0.05, temperature: float = 0.1) -> None:
        super().__init__(temperature)
        if not 0 < p < 1:
            raise ValueError(f"p must be in (0, 1), got {p}: its logit is learned.")
        check_finite(rate, "rate", minimum=0.0)
        self.p, self.rate = p, rate

    @property
    def learns(self) -> Mapping[str, Learned]:  # type: ignore[override]
        """The logits of the rates."""
        return {"dropout_logits": Learned(math.log(self.p / (1 - self.p)), self.rate)}

    def logits(self, x: Params) -> Tensor:
        """Return the learned logits."""
        assert x.learned is not None, "checked by check_needs"
        return x.learned["dropout_logits"]
