"""Memory of blocks, used again and again: fresh memory costs page faults, a tenth of the time on a CPU."""

from __future__ import annotations

import math

from torch import Tensor

from reference_trainer.render.footprints import PIXELS
from reference_trainer.render.tiles import Chunk

__all__ = ["Workspace"]


class Workspace:
    """Buffers of the size of a block, for one block of a chunk after the other.

    Args:
        count: the number of buffers.
        chunk: whose blocks they are for.
        like: a tensor of their dtype and device.
        channels: numbers for each pixel-Gaussian pair.
        pairs: how many pixel-Gaussian pairs are worked on at once, if a block is taken in parts; all by default.
    """

    def __init__(self, count: int, chunk: Chunk, like: Tensor, *, channels: int = 1, pairs: int | None = None) -> None:
        largest = max(math.prod(block.shape) for block in chunk.blocks) * PIXELS
        size = (largest if pairs is None else min(largest, pairs)) * channels
        self._buffers = [like.new_empty(size) for _ in range(count)]

    def of(self, *shape: int) -> list[Tensor]:
        """Return the buffers in a shape of at most the size of the largest block; what was in them is lost."""
        size = math.prod(shape)
        return [buffer[:size].view(shape) for buffer in self._buffers]
