"""What CUDA refuses and what it leaves open, as rules for the pretended card."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = [
    "SYNCHRONIZES",
    "check_determinism",
    "check_devices",
    "check_generator",
    "check_supported",
    "shuffled_additions",
]

SYNCHRONIZES = frozenset(
    f"aten::{name}"
    for name in (
        "_local_scalar_dense", "equal", "is_nonzero", "masked_select", "nonzero", "unique_dim",
        "_unique", "_unique2", "unique_consecutive", "repeat_interleave", "bincount",
    )
)  # fmt: skip
"""What makes the host wait for the card: a number is read, or the shape of a result depends on numbers."""
LARGEST_EIGH_BATCH = 32_768
"""cuSOLVER's batched solver fails beyond some tens of thousands of 3x3 matrices, with an internal error."""

_PRODUCTS = {f"aten::{name}" for name in ("mm", "bmm", "addmm", "baddbmm", "mv", "addmv", "dot", "vdot", "addbmm")}
_EIGEN = {f"aten::{name}" for name in ("linalg_eigh", "_linalg_eigh", "_linalg_eigh.eigenvalues")}
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


def check_devices(name: str, args: Sequence[Any], ours: Sequence[Tensor], foreign: Sequence[Tensor]) -> None:
    """Refuse to mix devices, but for what CUDA takes from the processor: copies, indices and single numbers.

    Args:
        name: of the operation.
        args: its positional arguments.
        ours: the tensors on the card among its arguments.
        foreign: tensors among its arguments that are not on the card, while others are.
    """
    if name in _CROSSING:
        return
    if len(cards := {x.device.index for x in ours}) > 1:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, found cards {sorted(cards)}")
    indices = args[1] if name in _INDEXING else ()
    for x in foreign:
        single = x.dim() == 0 and name not in _NO_NUMBERS_FROM_ELSEWHERE
        if not single and not any(x is index for index in indices):
            raise RuntimeError(f"{name}: expected all tensors to be on the same device, found the card and {x.device}")


def check_supported(name: str, ours: Sequence[Tensor]) -> None:
    """Refuse what CUDA has no kernel for: products of whole numbers, and eigenvalues of very many matrices.

    Args:
        name: of the operation.
        ours: the tensors on the card among its arguments.
    """
    if name in _PRODUCTS and not (ours[0].is_floating_point() or ours[0].is_complex()):
        raise RuntimeError(f'"addmm_cuda" not implemented for {ours[0].dtype}')
    if name in _EIGEN:
        if ours[0].dtype in (torch.float16, torch.bfloat16):
            raise RuntimeError(f'"linalg_eigh_cuda" not implemented for {ours[0].dtype}')
        if ours[0].shape[:-2].numel() > LARGEST_EIGH_BATCH:
            raise RuntimeError(
                f"cusolver error: CUSOLVER_STATUS_INVALID_VALUE, for a batch of {ours[0].shape[:-2].numel()}"
            )


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
