"""Adam over all parameters of a model in one launch, where PyTorch takes two for each."""

from __future__ import annotations

from collections.abc import Sequence

import triton
import triton.language as tl
from torch import Tensor

from reference_trainer.render.triton.launching import kernel, launch

__all__ = ["adam_step"]

_BLOCK = 1024
_AT_ONCE = 6  # tensors of a launch: a model's own parameters


@triton.jit
def _update(x, gradient, first, second, i, real, rate, gain1, gain2, correction, epsilon):
    """Update the numbers of one tensor at i: Kingma and Ba (2015), Algorithm 1, as PyTorch computes it."""
    g = tl.load(gradient + i, mask=real, other=0.0)
    m = tl.load(first + i, mask=real, other=0.0)
    v = tl.load(second + i, mask=real, other=0.0)
    m += gain1 * (g - m)
    v += gain2 * (g * g - v)
    tl.store(first + i, m, mask=real)
    tl.store(second + i, v, mask=real)
    old = tl.load(x + i, mask=real, other=0.0)
    tl.store(x + i, old - rate * m / (tl.sqrt(v) * correction + epsilon), mask=real)


@kernel
def adam(
    x0, g0, m0, v0, x1, g1, m1, v1, x2, g2, m2, v2, x3, g3, m3, v3, x4, g4, m4, v4, x5, g5, m5, v5,
    count0, count1, count2, count3, count4, count5, rate0, rate1, rate2, rate3, rate4, rate5,
    gain1, gain2, correction, epsilon, BLOCK: tl.constexpr,
):  # fmt: skip
    """Update up to six tensors; a program has a block of one of them, those of the first come first."""
    block = tl.program_id(0)
    lanes = tl.arange(0, BLOCK)
    end0 = tl.cdiv(count0, BLOCK)
    end1 = end0 + tl.cdiv(count1, BLOCK)
    end2 = end1 + tl.cdiv(count2, BLOCK)
    end3 = end2 + tl.cdiv(count3, BLOCK)
    end4 = end3 + tl.cdiv(count4, BLOCK)
    if block < end0:
        i = block * BLOCK + lanes
        _update(x0, g0, m0, v0, i, i < count0, rate0, gain1, gain2, correction, epsilon)
    elif block < end1:
        i = (block - end0) * BLOCK + lanes
        _update(x1, g1, m1, v1, i, i < count1, rate1, gain1, gain2, correction, epsilon)
    elif block < end2:
        i = (block - end1) * BLOCK + lanes
        _update(x2, g2, m2, v2, i, i < count2, rate2, gain1, gain2, correction, epsilon)
    elif block < end3:
        i = (block - end2) * BLOCK + lanes
        _update(x3, g3, m3, v3, i, i < count3, rate3, gain1, gain2, correction, epsilon)
    elif block < end4:
        i = (block - end3) * BLOCK + lanes
        _update(x4, g4, m4, v4, i, i < count4, rate4, gain1, gain2, correction, epsilon)
    else:
        i = (block - end4) * BLOCK + lanes
        _update(x5, g5, m5, v5, i, i < count5, rate5, gain1, gain2, correction, epsilon)


def adam_step(
    tensors: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, float]],
    step: int,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Update tensors in place, float32 and contiguous.

    Args:
        tensors: parameter, gradient, both moments, and learning rate of each.
        step: number of this step, from 1 on.
        betas: decay of the moments.
        epsilon: what is added to the root of the second moment.

    Raises:
        ValueError: for a tensor of 2^31 numbers or more, which the kernel cannot count.
    """
    if (most := max((one[0].numel() for one in tensors), default=0)) > 2**31 - _BLOCK:
        raise ValueError(f"a tensor must have fewer than 2^31 numbers, got {most}: train with use_engine('torch').")
    beta1, beta2 = betas
    # Both corrections, and what is 1 minus a number, in double precision on the processor.
    mean_correction, correction = 1 - beta1**step, (1 - beta2**step) ** -0.5
    given = [one for one in tensors if one[0].numel()]
    for begin in range(0, len(given), _AT_ONCE):
        some = given[begin : begin + _AT_ONCE]
        missing = [0] * (_AT_ONCE - len(some))  # for which pointers must be there all the same
        pointers = [x for one in (*some, *(some[0] for _ in missing)) for x in (one[0].detach(), *one[1:4])]
        counts = [one[0].numel() for one in some]
        rates = [one[4] / mean_correction for one in some] + [0.0 for _ in missing]
        blocks = sum(-(-count // _BLOCK) for count in counts)
        numbers = (*counts, *missing, *rates, 1 - beta1, 1 - beta2, correction, epsilon)
        launch(adam, (blocks,), *pointers, *numbers, warps=4, BLOCK=_BLOCK)
