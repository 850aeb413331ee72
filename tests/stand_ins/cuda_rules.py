"""What CUDA refuses and what it leaves open, as rules for the pretended card."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["check_determinism", "check_devices", "check_generator", "shuffled_additions"]

_CROSSING = {"aten::copy_", "aten::_to_copy"}
_INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
_NO_NUMBERS_FROM_ELSEWHERE = {"aten::cat", "aten::stack", "aten::_fused_adam_"}

# From the documentation of torch.use_deterministic_algorithms, and kthvalue from its source.
_NEVER_THE_SAME = {
    f"aten::{name}"
    for name in (
        "avg_pool3d_backward", "_adaptive_avg_pool2d_backward", "_adaptive_avg_pool3d_backward",
        "adaptive_max_pool2d_backward", "adaptive_max_pool3d_backward", "fractional_max_pool2d_backward",
        "fractional_max_pool3d_backward", "max_unpool2d", "max_unpool3d", "upsample_linear1d_backward",
        "upsample_bilinear2d_backward", "upsample_bicubic2d_backward", "_upsample_bilinear2d_aa_backward",
        "_upsample_bicubic2d_aa_backward", "upsample_trilinear3d_backward", "reflection_pad1d_backward",
        "reflection_pad2d_backward", "reflection_pad3d_backward", "nll_loss_forward", "nll_loss2d_forward",
        "_ctc_loss_backward", "_embedding_bag", "put_", "put", "histc", "kthvalue",
        "grid_sampler_2d_backward", "grid_sampler_3d_backward",
    )
}  # fmt: skip
_NEVER_THE_SAME_OF_FLOATS = {"aten::cumsum", "aten::cumsum_"}
_NEVER_THE_SAME_WITH_A_DIMENSION = {"aten::median", "aten::nanmedian"}
_ATOMIC = {"aten::index_add", "aten::index_add_"}  # with (self, dimension, index, source) as arguments


def check_devices(name: str, args: Sequence[Any], foreign: Sequence[Tensor]) -> None:
    """Refuse to mix devices, but for what CUDA takes from the processor: copies, indices and single numbers.

    Args:
        name: of the operation.
        args: its positional arguments.
        foreign: tensors among its arguments that are not on the card, while others are.
    """
    if name in _CROSSING:
        return
    indices = args[1] if name in _INDEXING else ()
    for x in foreign:
        single = x.dim() == 0 and name not in _NO_NUMBERS_FROM_ELSEWHERE
        if not single and not any(x is index for index in indices):
            raise RuntimeError(f"{name}: expected all tensors to be on the same device, found the card and {x.device}")


def check_generator(where: torch.device, device: torch.device) -> None:
    """Refuse a generator of another device."""
    if where.type != device.type:
        raise RuntimeError(f"expected a {device.type!r} generator but found {where.type!r}")


def check_determinism(name: str, args: Sequence[Any], ours: Sequence[Tensor]) -> None:
    """Refuse what has no algorithm that repeats itself, where such algorithms are asked for.

    Args:
        name: of the operation.
        args: its positional arguments.
        ours: the tensors on the card among its arguments.
    """
    if not torch.are_deterministic_algorithms_enabled():
        return
    if (
        name in _NEVER_THE_SAME
        or (name in _NEVER_THE_SAME_OF_FLOATS and ours[0].is_floating_point())
        or (name in _NEVER_THE_SAME_WITH_A_DIMENSION and len(args) > 1)
        or (name == "aten::bincount" and len(ours) > 1)  # with weights
    ):
        raise RuntimeError(f"{name} does not have a deterministic implementation on CUDA")


def shuffled_additions(name: str, args: tuple[Any, ...], generator: torch.Generator) -> tuple[Any, ...]:
    """Return the arguments of an operation with what atomics add up in another order; as they are for all others.

    On CUDA whoever comes first adds first, unless algorithms that repeat themselves are asked for.

    Args:
        name: of the operation.
        args: its positional arguments, on the processor.
        generator: of the order.
    """
    if name not in _ATOMIC or torch.are_deterministic_algorithms_enabled():
        return args
    target, dimension, index, source = args
    order = torch.randperm(index.shape[0], generator=generator)
    return target, dimension, index[order], source.index_select(dimension, order)
