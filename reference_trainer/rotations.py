"""Quaternions as rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["rotation_matrices", "rotations"]

_NO_DIRECTION = 1e-30  # a quaternion well below this is taken for 0


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Turn quaternions (N, 4) into rotation matrices (N, 3, 3).

    Convention: wxyz, of any norm; they are normalized here. A zero quaternion gives the identity and a gradient of 0.

    Example:
        >>> rotation_matrices(torch.tensor([[2.0, 0.0, 0.0, 0.0]]))[0].tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return rotations(quaternions).permute(2, 0, 1)


def rotations(quaternions: Tensor) -> Tensor:
    """Turn quaternions (N, 4) into rotation matrices (3, 3, N): long last axes are several times faster on a CPU."""
    # Divided by the largest component first: its square would overflow from 1e19 on, or underflow.
    largest = quaternions.detach().abs().amax(1).clamp_(min=_NO_DIRECTION)
    w, x, y, z = torch.nn.functional.normalize(quaternions.T / largest, dim=0).unbind(0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows).view(3, 3, -1)
