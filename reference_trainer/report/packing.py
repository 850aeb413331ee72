"""Pictures and numbers as text to embed in a page, small without a visible loss."""

from __future__ import annotations

import zlib
from base64 import b64encode
from collections.abc import Iterable
from io import BytesIO
from typing import Any

import torch
from torch import Tensor

from reference_trainer.evaluation.pictures import as_pillow

__all__ = ["heat_uri", "image_uri", "quantized"]


def image_uri(image: Tensor) -> str:
    """Return an image (3, H, W) in [0, 1] as the data URI of a JPEG of high quality."""
    # Without the usual subsampling, which halves the resolution of colors.
    return _uri(as_pillow(image), "jpeg", quality=92, subsampling=0, progressive=True, optimize=True)


def heat_uri(image: Tensor) -> str:
    """Return a heat map (3, H, W) as the data URI of a WebP without loss, of 48 of its colors.

    A photograph's compression blurs colors, which in a heat map are the values.
    """
    return _uri(as_pillow(image).quantize(48, dither=0).convert("RGB"), "webp", lossless=True, method=6)


def _uri(image: Any, kind: str, **options: Any) -> str:
    file = BytesIO()
    image.save(file, kind.upper(), **options)
    return f"data:image/{kind};base64,{b64encode(file.getvalue()).decode()}"


def quantized(columns: Iterable[tuple[Tensor, float]]) -> dict[str, Any]:
    """Return numbers as multiples of a step, compressed: small if they are, or if they resemble their neighbors.

    Args:
        columns: blocks (N, k) of numbers, each with its step; where that would give more than 16 bits, it is larger.

    Returns:
        ``text``: base64 of a zlib stream. It holds, column by column, the low bytes of N whole numbers and then their
        high bytes; 0, 1, 2, 3, 4 stand for 0, -1, 1, -2, 2. ``steps``: the step of every column.

    Example:
        >>> quantized([(torch.tensor([[0.0], [0.5], [-0.5]]), 0.5)])["steps"]
        [0.5]
    """
    planes, steps = list[bytes](), list[float]()
    for block, least in columns:
        block = block.detach().double().cpu()
        step = max(least, block.abs().max().item() / 32767) if block.numel() else least
        # Small numbers of either sign become small non-negative ones, whose high bytes are all 0. These bytes stand
        # together, so that they cost next to nothing once compressed.
        whole = (block / step).round().to(torch.int64)
        coded = torch.where(whole < 0, -2 * whole - 1, 2 * whole)
        planes += [part.to(torch.uint8).numpy().tobytes() for of in coded.T for part in (of % 256, of // 256)]
        steps += [step] * block.shape[1]
    return {"text": b64encode(zlib.compress(b"".join(planes), 9)).decode(), "steps": steps}
