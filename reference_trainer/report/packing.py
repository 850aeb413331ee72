"""Pictures and numbers as text to embed in a page."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO

from torch import Tensor

from reference_trainer.evaluation.pictures import as_pillow

__all__ = ["data_uri", "jpeg", "numbers"]


def data_uri(content: bytes, kind: str) -> str:
    """Return content of the MIME type ``kind`` as a data URI.

    Example:
        >>> data_uri(b"<svg/>", "image/svg+xml")
        'data:image/svg+xml;base64,PHN2Zy8+'
    """
    return f"data:{kind};base64,{b64encode(content).decode()}"


def jpeg(image: Tensor) -> str:
    """Return an image (3, H, W) in [0, 1] as the data URI of a high-quality JPEG."""
    file = BytesIO()
    as_pillow(image).save(file, "JPEG", quality=93, subsampling=0)
    return data_uri(file.getvalue(), "image/jpeg")


def numbers(x: Tensor, kind: str) -> str:
    """Return a tensor, row-major, as numbers of the NumPy type ``kind`` in base64.

    Example:
        >>> import torch
        >>> numbers(torch.tensor([1.0]), "<f4")
        'AACAPw=='
    """
    return b64encode(x.detach().cpu().numpy().astype(kind).tobytes()).decode()
