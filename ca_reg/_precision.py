"""The least precision in which distances and moments are computed."""

from __future__ import annotations

import torch
from torch import Tensor


def at_least_single(x: Tensor, *, copy: bool = False) -> Tensor:
    """Return a tensor in float32, or in its own dtype if that is wider."""
    return x.to(torch.promote_types(x.dtype, torch.float32), copy=copy)


def without_autocast(device: torch.device) -> torch.autocast:
    """Return a context in which torch.autocast does not reduce the precision of matrix products."""
    return torch.autocast(device.type, enabled=False)
