"""Opacity decay, which keeps Gaussians from staying where the photographs do not ask for them at every step."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg._check import check_count, check_factor
from ca_reg.functional import decayed_logits

__all__ = ["OpacityDecay"]


class OpacityDecay:
    """Multiplies all opacities by a factor after every optimizer step, from a step on.

    What no photograph holds up fades, until density control prunes it. With dropout it is what the recipe ``sparse`` of
    ``ca-reg train`` does; the factor is that of Binocular3DGS (Han et al. 2024, "opacity penalty"). It changes the
    parameter alone: the state of the optimizer stays.

    Args:
        factor: in (0, 1]; 1 does nothing.
        start: the step after which it begins, best the one at which density control does, which prunes what has faded.

    Raises:
        TypeError: if ``factor`` is no number, or ``start`` no integer.
        ValueError: if ``factor`` is outside (0, 1], or ``start`` negative.

    Example:
        >>> decay = OpacityDecay(0.5, start=10)
        >>> logits = torch.nn.Parameter(torch.zeros(3))       # after optimizer.step(), in every step:
        >>> decay(logits, 10)
        >>> decay(logits, 11)
        >>> logits.sigmoid().tolist()
        [0.25, 0.25, 0.25]
    """

    def __init__(self, factor: float = 0.995, *, start: int = 500) -> None:
        check_factor(factor)
        check_count(start, "start", minimum=0)
        self.factor, self.start = factor, start

    @torch.no_grad()
    def __call__(self, logits: Tensor, step: int) -> None:
        """Decay in place.

        Args:
            logits: the trained parameter whose sigmoid is the opacity, of any shape.
            step: the number of the optimizer step that was made last.

        Raises:
            TypeError: if the logits are no floating-point tensor, or of bfloat16.
        """
        if step > self.start:
            decayed = decayed_logits(logits, self.factor)
            logits.copy_(decayed)

    def __repr__(self) -> str:
        """Return the call that makes it."""
        return f"OpacityDecay({self.factor}, start={self.start})"
