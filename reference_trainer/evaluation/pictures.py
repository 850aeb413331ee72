"""Pictures of results: PNG files, animations, heat maps, side-by-side comparisons."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reference_trainer.files import replacing
from reference_trainer.scenes.images import IMAGE_SUFFIXES

__all__ = ["PANEL", "as_pillow", "file_names", "heat_colors", "heat_map", "save_gif", "save_png", "side_by_side"]

PANEL = "_panel"
"""Suffix of a view's panel, after the name of its render."""

_GAP = 4  # pixels between pictures
_LABEL_HEIGHT = 16  # pixels; Pillow's built-in font is about 11 high
_UNDEFINED = "0.5"  # gray for values that are not finite; not a color of the map


def file_names(views: Sequence[str]) -> list[str]:
    """Return a unique file name without extension for each view's pictures; none is that of another view's panel.

    It is the view's own name without its folder, or with the folders if two views would share it. Case is ignored, as
    by some file systems. Pass all views whose pictures go into one folder in one call.

    Example:
        >>> file_names(["images/0001.jpg", "a/r_0.png", "b/r_0.png"])
        ['0001', 'a_r_0', 'b_r_0']
    """
    paths = [PurePosixPath(view) for view in views]
    # Names of photographs may contain other dots, and views from transforms files have no extension.
    plain = [path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path for path in paths]
    shared = Counter(path.name.casefold() for path in plain)
    taken, names = set[str](), list[str]()
    for path, short in zip(paths, plain, strict=True):
        full = "_".join(short.parts)
        offered = [short.name] if shared[short.name.casefold()] == 1 else []
        offered += [full, "_".join(path.parts)]
        for name in chain(offered, (f"{full}_{number}" for number in count(2))):
            files = {name.casefold(), f"{name}{PANEL}".casefold()}
            if not files & taken:
                break
        taken |= files
        names.append(name)
    return names


def save_png(path: str | Path, image: Tensor) -> None:
    """Write an image (3, H, W), clamped to [0, 1], as an 8-bit PNG, atomically; missing folders are made.

    Raises ValueError if the shape is another or a value is NaN, and OSError if the file cannot be written.
    """
    picture = as_pillow(image)
    with replacing(path) as place:
        picture.save(place, format="PNG")


def save_gif(path: str | Path, images: Sequence[Tensor]) -> None:
    """Write pictures, at least one, as a looping GIF of 20 per second; otherwise as `save_png`."""
    frames = [as_pillow(image) for image in images]
    with replacing(path) as place:
        frames[0].save(place, "GIF", save_all=True, append_images=frames[1:], duration=50, loop=0)


def as_pillow(image: Tensor) -> Any:
    """Return an image (3, H, W) as a Pillow image; errors as for `save_png`."""
    from PIL import Image

    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"expected an image of shape (3, H, W), got {tuple(image.shape)}.")
    if bool(image.isnan().any()):
        raise ValueError("the image holds NaN; look for the cause in the rendering, or draw it with heat_map.")
    pixels = (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8)
    return Image.fromarray(pixels.permute(1, 2, 0).contiguous().numpy())


def heat_map(values: Tensor, vmax: float) -> Tensor:
    """Color values (H, W) from 0 (black) through red to ``vmax`` (pale yellow): matplotlib's "inferno".

    Values beyond the ends take the end colors; those that are not finite (a pixel without a score) are gray. Use one
    ``vmax`` for all maps to be compared. Returns colors (3, H, W) in [0, 1], float32, on the CPU.

    Raises:
        ValueError: if ``values`` is not (H, W) or ``vmax`` is not positive.

    Example:
        >>> heat_map(torch.tensor([[0.0, 1.0]]), vmax=1.0).mean(0)[0].diff() > 0
        tensor([True])
    """
    import matplotlib

    if values.ndim != 2:
        raise ValueError(f"values must have shape (H, W), got {tuple(values.shape)}.")
    if not vmax > 0:
        raise ValueError(f"vmax must be positive, got {vmax}.")
    colors = matplotlib.colormaps["inferno"].with_extremes(bad=_UNDEFINED)
    defined = np.ma.masked_invalid(values.detach().to("cpu", torch.float64).numpy())
    return torch.from_numpy(colors(defined / vmax)[..., :3]).float().permute(2, 0, 1).contiguous()


def heat_colors(values: Tensor, low: float, high: float) -> Tensor:
    """Color values on a logarithmic scale; return colors (N, 3) in [0, 1] on the CPU.

    Args:
        values: at least 0, possibly infinite, shape (N,).
        low: positive; values up to it get the darkest color.
        high: values from it on get the brightest color.
    """
    along = (values.clamp(low, high) / low).log() / math.log(high / low)
    return heat_map(along[None], 1.0)[:, 0].T


def side_by_side(images: Sequence[Tensor], labels: Sequence[str], *, columns: int | None = None) -> Tensor:
    """Arrange pictures (3, H, W) in [0, 1] of one size in a grid, each with a label above, with thin white gaps.

    Labels should be Latin letters (the built-in font has few others); a column is at least as wide as its labels.
    Without ``columns`` all pictures form one row.

    Returns:
        Colors in [0, 1], shape (3, H', W'), on the CPU, rounded to bytes.

    Raises:
        ValueError: if there is no image, the sizes or the numbers differ, or ``columns`` is not positive.

    Example:
        >>> side_by_side([torch.zeros(3, 30, 40)] * 3, ["a", "b", "c"], columns=2).shape
        torch.Size([3, 96, 84])
    """
    from PIL import Image, ImageDraw

    if not images or len(images) != len(labels):
        raise ValueError(f"expected one label for each of at least one image, got {len(images)} and {len(labels)}.")
    pictures = [as_pillow(image) for image in images]
    if len({picture.size for picture in pictures}) != 1:
        raise ValueError(f"the images must have one size, got {[tuple(image.shape) for image in images]}.")
    columns = min(len(images), len(images) if columns is None else columns)
    if columns < 1:
        raise ValueError(f"columns must be positive, got {columns}.")
    width, cell = pictures[0].width, pictures[0].height + _LABEL_HEIGHT + _GAP
    measure = ImageDraw.Draw(pictures[0]).textlength
    needed = [max(width, math.ceil(measure(label)) + 4) for label in labels]
    widths = [max(needed[column::columns]) for column in range(columns)]
    size = (sum(widths) + (columns - 1) * _GAP, -(-len(images) // columns) * cell - _GAP)
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    for index, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        row, column = divmod(index, columns)
        left = sum(widths[:column]) + column * _GAP
        pen.text((left + 2, row * cell + 2), label, fill="black")
        sheet.paste(picture, (left, row * cell + _LABEL_HEIGHT))
    return torch.from_numpy(np.array(sheet)).permute(2, 0, 1) / 255
