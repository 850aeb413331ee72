"""The base class of every term of the training loss."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

if TYPE_CHECKING:
    from reference_trainer.training.step import Step

__all__ = ["LossTerm"]


class LossTerm(abc.ABC):
    """A summand of the loss of a step, its weight included; a term of one's own is a subclass.

    Attributes:
        needs: of the renderer, beside image and alpha: ``"depth"``, which the render of the step then has, or
            ``"moments"``.
        analytic: whether the term knows what to do with an expected image and its variance, without a draw.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    analytic: ClassVar[bool] = False

    @abc.abstractmethod
    def __call__(self, step: Step) -> Tensor:
        """Return a scalar, differentiable in the parameters of the model."""
