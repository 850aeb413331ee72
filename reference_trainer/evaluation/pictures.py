"""Pictures of results: PNG files, animations, heat maps, side-by-side comparisons, figures."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ca_reg.monitor import LOG_NAME, plot_dynamics
from reference_trainer.evaluation.style import WIDTH, color, in_thousandths, new_figure, readable
from reference_trainer.files import has_mark, replacing
from reference_trainer.scenes.images import IMAGE_SUFFIXES, read_image

__all__ = [
    "PANEL", "as_pillow", "color_bar", "comparison_figure", "dynamics_figure", "file_names", "heat_colors",
    "heat_map", "is_own_png", "label_font", "logs_exact", "save_film", "save_png", "side_by_side",
]  # fmt: skip

PANEL = "_panel"
"""Suffix of a view's panel, after the name of its render."""

_MADE_BY = "ca_reg"  # in the header of every PNG
_RATE = 20  # pictures of a film per second
_GAP = 4  # pixels between pictures
_TEXT, _LINE, _BAR = 15, 20, 8  # pixels: size of letters, height of a line of them, height of a color bar
_UNDEFINED = "0.5"  # gray for values that are not finite; not a color of the map


def file_names(views: Sequence[str], ends: Sequence[str] = ("", PANEL)) -> list[str]:
    """Return a file name without extension for each view, so that no two pictures, whose names have these ends, clash.

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
            files = {f"{name}{end}".casefold() for end in ends}
            if not files & taken:
                break
        taken |= files
        names.append(name)
    return names


def save_png(path: str | Path, image: Tensor) -> None:
    """Write an image (3, H, W), clamped to [0, 1], as an 8-bit PNG, atomically; missing folders are made.

    Raises ValueError if the shape is another or a value is NaN, and OSError if the file cannot be written.
    """
    from PIL.PngImagePlugin import PngInfo

    pillow, note = as_pillow(image), PngInfo()
    note.add_text("Software", _MADE_BY)
    with replacing(path) as place:
        pillow.save(place, format="PNG", pnginfo=note)


def is_own_png(path: Path) -> bool:
    """Whether a picture is from `save_png`, or there is none: what may be overwritten without asking."""
    # The text is the first thing after the size, and nothing has to be decoded.
    return not path.exists() or has_mark(path, b"Software\0" + _MADE_BY.encode(), within=200)


def save_film(folder: Path, name: str, images: Sequence[Tensor]) -> Path:
    """Write pictures, at least one, as a film of 20 a second; return its file.

    Smaller ones get a white margin to the right and below. An MP4 (H.264), which everything plays, cut to an even size,
    where PyAV is installed; else a looping animated WebP, for browsers. Errors as for `save_png`.
    """
    frames = [as_pillow(image) for image in _of_one_size(images)]
    try:
        import av
    except ImportError:
        with replacing(path := folder / f"{name}.webp") as place:
            frames[0].save(
                place, "WEBP", save_all=True, append_images=frames[1:], duration=1000 // _RATE, loop=0, quality=85
            )
        return path
    width, height = (side // 2 * 2 for side in frames[0].size)  # H.264 has half the resolution in color
    with replacing(path := folder / f"{name}.mp4") as place, av.open(str(place), "w", format="mp4") as file:
        stream = file.add_stream("h264", rate=_RATE, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in [*(av.VideoFrame.from_image(each.crop((0, 0, width, height))) for each in frames), None]:
            file.mux(stream.encode(frame))
    return path


def as_pillow(image: Tensor) -> Any:
    """Return an image (3, H, W) as a Pillow image; errors as for `save_png`."""
    from PIL import Image

    if image.ndim != 3 or image.shape[0] != 3:
        raise ValueError(f"expected an image of shape (3, H, W), got {tuple(image.shape)}.")
    if bool(image.isnan().any()):
        raise ValueError("the image holds NaN; look for the cause in the rendering, or show it with heat_map.")
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
    """Color values (N,), at least 0 and possibly infinite, on a logarithmic scale from ``low``, above 0, to ``high``.

    Returns colors (N, 3) in [0, 1] on the CPU; values beyond the ends take the end colors.
    """
    along = (values.clamp(low, high) / low).log() / math.log(high / low)
    return heat_map(along[None], 1.0)[:, 0].T


@cache
def label_font() -> Any:
    """Return the font of labels in pictures for Pillow: matplotlib's DejaVu Sans."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")), _TEXT)


def color_bar(low: str, high: str, *, width: int) -> Tensor:
    """Return the colors of `heat_map` from left to right, with what they mean at the ends below: (3, 28, width)."""
    from PIL import Image, ImageDraw

    sheet = Image.new("RGB", (width, _BAR + _LINE), "white")
    sheet.paste(as_pillow(heat_map(torch.linspace(0, 1, width).expand(_BAR, -1), 1.0)))
    pen = ImageDraw.Draw(sheet)
    for at, anchor, text in ((2, "la", low), (width - 2, "ra", high)):
        pen.text((at, _BAR + 1), text, fill="black", font=label_font(), anchor=anchor)
    return torch.from_numpy(np.array(sheet)).permute(2, 0, 1) / 255


def side_by_side(
    images: Sequence[Tensor],
    labels: Sequence[str],
    *,
    columns: int | None = None,
    scales: Sequence[tuple[str, str] | None] = (),
) -> Tensor:
    """Arrange pictures (3, H, W) in [0, 1] of one size in a grid, each with a label above, with thin white gaps.

    A column is at least as wide as its labels. Without ``columns`` all pictures form one row. ``scales`` are the ends
    of each picture's color bar, which is put below it; None for a picture without. Returns colors in [0, 1], (3, H',
    W'), on the CPU, rounded to bytes. Raises ValueError if there is no image, the sizes or the numbers differ, or
    ``columns`` is not positive.

    Example:
        >>> side_by_side([torch.zeros(3, 30, 40)] * 3, ["a", "b", "c"], columns=2).shape
        torch.Size([3, 104, 84])
    """
    from PIL import Image, ImageDraw

    scales = scales or [None] * len(images)
    if not images or not len(images) == len(labels) == len(scales):
        raise ValueError(f"expected one label for each of at least one image, got {len(images)} and {len(labels)}.")
    panels = [as_pillow(image) for image in images]
    if len({panel.size for panel in panels}) != 1:
        raise ValueError(f"the images must have one size, got {[tuple(image.shape) for image in images]}.")
    columns = min(len(images), len(images) if columns is None else columns)
    if columns < 1:
        raise ValueError(f"columns must be positive, got {columns}.")
    width, height = panels[0].size
    cell = _LINE + height + (_BAR + _LINE + 2 if any(scales) else 0) + _GAP
    needed = [max(width, math.ceil(label_font().getlength(label)) + 4) for label in labels]
    widths = [max(needed[column::columns]) for column in range(columns)]
    size = (sum(widths) + (columns - 1) * _GAP, -(-len(images) // columns) * cell - _GAP)
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    for index, (panel, label, scale) in enumerate(zip(panels, labels, scales, strict=True)):
        row, column = divmod(index, columns)
        left, top = sum(widths[:column]) + column * _GAP, row * cell
        pen.text((left + 2, top + 1), label, fill="black", font=label_font())
        sheet.paste(panel, (left, top + _LINE))
        if scale:
            sheet.paste(as_pillow(color_bar(*scale, width=width)), (left, top + _LINE + height + 2))
    return torch.from_numpy(np.array(sheet)).permute(2, 0, 1) / 255


def dynamics_figure(runs: Mapping[str, Path], path: Path) -> None:
    """Plot CA and PSNR of several runs, folders by label, against the iteration (paper, training dynamics)."""
    with new_figure(path) as figure:
        figure.set_size_inches(WIDTH, 4.4)
        colors = {label: color(label, number) for number, label in enumerate(runs)}
        ca_axes, psnr_axes = plot_dynamics(dict(runs), axes=figure.subplots(1, 2), colors=colors)
        in_thousandths(ca_axes.yaxis, "exact CA" if all(map(logs_exact, runs.values())) else "CA")
        ca_axes.set_title("Co-adaptation")
        psnr_axes.set_title("Quality")
        if (beside := psnr_axes.get_legend()) is not None:
            beside.remove()  # below both is room for long names
        names = [" ".join(map(readable, str(line.get_label()).rsplit(" ", 1))) for line in ca_axes.lines]
        figure.legend(ca_axes.lines, names, loc="outside lower center", ncols=max(1, min(4, len(runs))))


def logs_exact(folder: Path) -> bool:
    """Whether the log of a run holds the exact score at drop rate 1/2, by its last line."""
    with suppress(OSError, ValueError, IndexError, AttributeError):
        last = json.loads((folder / LOG_NAME).read_text("utf-8").splitlines()[-1])
        return bool(last.get("method") == "exact" and last.get("drop_rate") == 0.5)
    return False


def comparison_figure(runs: Mapping[str, Path], path: Path, *, view: str, split: str = "test") -> None:
    """Stack the panels (photograph, render, error, CA map) of one view under several strategies, runs by label.

    ``view`` is the name of the view's files, see `file_names`.
    """
    panels = [read_image(folder / "views" / split / f"{view}{PANEL}.png")[0] for folder in runs.values()]
    save_png(path, side_by_side([*_of_one_size(panels)], [*map(readable, runs)], columns=1))


def _of_one_size(images: Sequence[Tensor]) -> Iterator[Tensor]:
    """Yield pictures (3, H, W) with white margins, where labels made some of them smaller."""
    height, width = (max(image.shape[axis] for image in images) for axis in (1, 2))
    for image in images:
        yield pad(image, (0, width - image.shape[2], 0, height - image.shape[1]), value=1.0)
