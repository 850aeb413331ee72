"""What density control counts of a step, in one launch."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from reference_trainer.render.triton.launching import kernel, launch

__all__ = ["count_gradients"]

_BLOCK = 256


@triton.jit
def _norm(gradient, j, stride, real, half_width, half_height):
    """Return the norms of gradients per pixel in half image sizes."""
    x = tl.load(gradient + j.to(tl.int64) * stride, mask=real, other=0.0) * half_width
    y = tl.load(gradient + j.to(tl.int64) * stride + 1, mask=real, other=0.0) * half_height
    # As hypot: the square of a small gradient would underflow.
    longer, shorter = tl.maximum(tl.abs(x), tl.abs(y)), tl.minimum(tl.abs(x), tl.abs(y))
    ratio = shorter / tl.where(longer > 0, longer, 1.0)
    return longer * tl.sqrt(1 + ratio * ratio)


@kernel
def add_gradients(
    indices, touched, gradient, absolute, sums, steps, absolute_sums, count, stride, absolute_stride,
    half_width, half_height, ABSOLUTE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add to the sums of the Gaussians at the indices, each of which is there once: no two programs meet."""
    j = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = j < count
    i = tl.load(indices + j, mask=real, other=0)
    norm = _norm(gradient, j, stride, real, half_width, half_height)
    tl.store(sums + i, tl.load(sums + i, mask=real, other=0.0) + norm, mask=real)
    seen = tl.load(touched + j, mask=real, other=0).to(tl.float32)
    tl.store(steps + i, tl.load(steps + i, mask=real, other=0.0) + seen, mask=real)
    if ABSOLUTE:
        norm = _norm(absolute, j, absolute_stride, real, half_width, half_height)
        tl.store(absolute_sums + i, tl.load(absolute_sums + i, mask=real, other=0.0) + norm, mask=real)


def count_gradients(
    indices: Tensor,
    touched: Tensor,
    gradient: Tensor,
    absolute: Tensor | None,
    sums: Tensor,
    steps: Tensor,
    absolute_sums: Tensor | None,
    width: int,
    height: int,
) -> None:
    """Add a step to sums, steps and, if there are, absolute sums, each (N,), float32; see `DensityStatistics.update`.

    Indices (M,) int64 name every Gaussian at most once, touched (M,) is bool, the gradients are (M, 2) float32.
    """
    both = absolute is not None and absolute_sums is not None
    signed = gradient if gradient.stride(1) == 1 else gradient.contiguous()
    other, others = (absolute.contiguous(), absolute_sums) if both else (signed, sums)  # type: ignore[union-attr]
    pointers = indices.contiguous(), touched.contiguous().view(torch.uint8), signed, other, sums, steps, others
    sizes = len(indices), signed.stride(0), other.stride(0), 0.5 * width, 0.5 * height
    grid = (-(-len(indices) // _BLOCK),)
    launch(add_gradients, grid, *pointers, *sizes, warps=4, ABSOLUTE=both, BLOCK=_BLOCK)
