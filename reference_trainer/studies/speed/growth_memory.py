"""How much memory a rendering needs: a formula counted from the code, and the counts it is evaluated on.

A peak is the largest of several phases; a phase is a sum of bytes per Gaussian, per list entry and so on. The numbers
are those of float32 tensors alive at the same time on a CPU, whose lists are sorted in 64-bit integers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from reference_trainer.render import Splats, splat
from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.footprints import PIXELS, block_size
from reference_trainer.studies.speed.measure import PASSES
from reference_trainer.studies.speed.workloads import Workload

__all__ = ["PHASES", "Counts", "Peak", "Phase", "count", "predict"]


@dataclass(frozen=True)
class Counts:
    """What the memory of a rendering grows with.

    Args:
        gaussians: those in front of the camera.
        strips: pairs of a Gaussian and a row of tiles that it meets, beside the image too.
        entries: pairs of a Gaussian and a tile that it meets: the lengths of all lists.
        pixels: of all tiles, that is of the picture padded to whole tiles.
        chunks: of every chunk in turn its list entries, padding included (at most `CHUNK_ENTRIES` or one block), the
            pixels of its tiles, and the pixel-Gaussian pairs of its largest block (at most the block size or one tile's
            list times its 64 pixels).
    """

    gaussians: int
    strips: int
    entries: int
    pixels: int
    chunks: tuple[tuple[int, int, int], ...]


_NOTHING = (0, 0, 0)


class Phase(NamedTuple):
    """Bytes that live at the peak of a phase.

    Args:
        gaussian: per Gaussian.
        strip: per Gaussian and row of tiles.
        entry: per list entry.
        pixel: per pixel.
        chunk: per entry, pixel and pair of the chunk that is at work.
        earlier: the same for the chunk before, which lives on until the next one has replaced it.
    """

    gaussian: float
    strip: float
    entry: float
    pixel: float
    chunk: tuple[float, float, float] = _NOTHING
    earlier: tuple[float, float, float] = _NOTHING

    def total(self, counts: Counts) -> int:
        """Return the sum for given counts, bytes."""
        c = counts
        fixed = self.gaussian * c.gaussians + self.strip * c.strips + self.entry * c.entries + self.pixel * c.pixels
        chunks = c.chunks or (_NOTHING,)
        sums = [_dot(self.chunk, x) + _dot(self.earlier, y) for x, y in zip(chunks, (_NOTHING, *chunks), strict=False)]
        return math.ceil(fixed + max(sums))


class Peak(NamedTuple):
    """The largest phase: its bytes and its name."""

    bytes: int
    phase: str


_INDICES, _DEPTHS, _PROJECTION, _TOUCHED = 8, 4, 44, 1
_READY = _INDICES + _PROJECTION + _TOUCHED
_VALUES, _TABLES = 4 + 16, 24 + 16  # ones and the values beside the colours; packed and padded rows
_LIST = 8  # the number of a Gaussian
_TILES = 3 * 8 / PIXELS  # length, order and start of every list
_SUMS, _IMAGE = 16, 16  # three colours and alpha, tile by tile and as an image
_CHUNK, _POLYNOMIAL, _OF_ENTRIES = 8 + 8, 24, 16
_FOOTPRINTS = 24 + 4 * 4  # the gathered table, dx, dy, w1, w2
_TERMS = 24 + 8  # of the polynomial before they are stacked, and the row of the tile
_ALPHAS, _ALONG = 4 * 4, 2 * 4  # four buffers of a block, and the two more of the backward pass
_GRADIENTS = 40  # six of the table and four of the values
_SAVED = 66 * 4  # what autograd keeps of the projection and of what it joins
# Until the next chunk is as far, its names still hold the chunk before; views of its last block hold it even longer.
_EARLIER = (_POLYNOMIAL + _OF_ENTRIES, _SUMS, _ALPHAS)
_EARLIER_BACKWARD = (_POLYNOMIAL + _FOOTPRINTS + _OF_ENTRIES + _GRADIENTS, _SUMS, _ALPHAS + _ALONG)

_DRAWING = (_READY + _VALUES + _TABLES, 0, _LIST, _SUMS + _TILES)
_BLENDING = (_CHUNK + _POLYNOMIAL + _OF_ENTRIES, _SUMS, _ALPHAS)
_FORWARD = {
    "projection": Phase(_INDICES + _DEPTHS + 38 * 4, 0, 0, 0),
    # Per Gaussian the sorted copy and the rows; per strip 13 vectors that live until the end; per entry strip, column,
    # tile and Gaussian, and while they are sorted the 32-bit tile, its copy, the permutation and the positions.
    "lists": Phase(_INDICES + _DEPTHS + _PROJECTION + 72, 76, 4 * 8 + 2 * 4 + 2 * 8, 0),
    "footprints": Phase(*_DRAWING, (_CHUNK + _FOOTPRINTS + _TERMS + _POLYNOMIAL, 0, 0), _EARLIER),
    "blocks": Phase(*_DRAWING, _BLENDING, (_OF_ENTRIES, _SUMS, _ALPHAS)),
    "image": Phase(*_DRAWING[:3], _SUMS + _IMAGE + _TILES, _BLENDING),
}

_BASE_BACKWARD = Phase(_READY + _SAVED + _GRADIENTS, 0, _LIST, _SUMS + _IMAGE + _TILES)
_HELD = _CHUNK + _POLYNOMIAL + _FOOTPRINTS + _OF_ENTRIES + _GRADIENTS
_BACKWARD = {
    "loss": Phase(_READY + _SAVED, 0, _LIST, _IMAGE + 44 + _TILES),
    "backward footprints": _BASE_BACKWARD._replace(
        chunk=(_CHUNK + _FOOTPRINTS + _TERMS + _POLYNOMIAL, 0, 0), earlier=_EARLIER_BACKWARD
    ),
    "backward blocks": _BASE_BACKWARD._replace(
        chunk=(_HELD, _SUMS, _ALPHAS + _ALONG), earlier=(_OF_ENTRIES + _GRADIENTS, _SUMS, _ALPHAS + _ALONG)
    ),
    "backward geometry": _BASE_BACKWARD._replace(chunk=(_HELD + 2 * 24 + 8, _SUMS, _ALPHAS + _ALONG)),
    "backward projection": Phase(_READY + _SAVED + 64, 0, _LIST, _TILES),
}

PHASES: dict[str, dict[str, Phase]] = {
    PASSES[0]: _FORWARD,
    PASSES[1]: {
        **{name: phase._replace(gaussian=phase.gaussian + _SAVED) for name, phase in _FORWARD.items()},
        **_BACKWARD,
    },
}
"""The formula: by "forward" and "forward+backward", then by phase."""


def predict(counts: Counts) -> dict[str, Peak]:
    """Return the peak of the memory above the inputs, by "forward" and "forward+backward".

    Example:
        >>> peaks = predict(Counts(1000, 0, 0, 0, ()))  # all of them beside the image
        >>> peaks["forward"]
        Peak(bytes=164000, phase='projection')
    """
    return {
        name: max((Peak(phase.total(counts), title) for title, phase in phases.items()), key=lambda peak: peak.bytes)
        for name, phases in PHASES.items()
    }


@torch.no_grad()
def count(workload: Workload) -> Counts:
    """Project and list a workload, and count what its memory grows with.

    Example:
        >>> from reference_trainer.studies.speed.workloads import WorkloadSpec
        >>> counts = count(WorkloadSpec(20, 16, 16, 0.1).make())
        >>> counts.gaussians, counts.pixels, len(counts.chunks)
        (20, 256, 1)
    """
    w = workload
    splats = splat(w.means, w.quaternions, w.scales, w.opacities, w.camera, colors=w.colors)
    return Counts(
        gaussians=splats.indices.shape[0],
        strips=int(_rows(splats).sum()),
        entries=splats.lists.gaussians.shape[0],
        pixels=splats.lists.lengths.shape[0] * PIXELS,
        chunks=tuple(
            (
                chunk.gaussians.shape[0],
                chunk.tiles.shape[0] * PIXELS,
                max(math.prod(block.shape) for block in chunk.blocks) * PIXELS,
            )
            for chunk in splats.lists.chunks(block_size(w.means.device))
        ),
    )


def _dot(rates: tuple[float, float, float], sizes: tuple[int, int, int]) -> float:
    """Multiply and sum."""
    return sum(a * b for a, b in zip(rates, sizes, strict=True))


def _rows(splats: Splats) -> Tensor:
    """Return in how many rows of tiles each Gaussian reaches `MIN_ALPHA` at the height of a pixel centre."""
    y, height = splats.projection.means[:, 1], splats.lists.height
    reach = torch.sqrt(2 * torch.log(splats.opacities / MIN_ALPHA).clamp(min=0) * splats.projection.covariances[:, 2])
    top, bottom = (y - reach - 0.5).ceil().clamp(0, height), (y + reach - 0.5).floor().clamp(-1, height - 1)
    rows = torch.div(bottom, TILE, rounding_mode="floor") - torch.div(top, TILE, rounding_mode="floor") + 1
    return torch.where(bottom >= top, rows, 0)
