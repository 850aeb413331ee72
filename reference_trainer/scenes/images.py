"""Image files: reading, compositing, resizing, and finding those that a scene file names."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "composite",
    "decode_image",
    "has_alpha",
    "image_folder",
    "image_size",
    "is_image",
    "list_images",
    "match_images",
    "opened_image",
    "path_inside",
    "photograph_folder",
    "read_image",
    "reduction",
    "resize_image",
    "unreadable_photographs",
]  # fmt: skip

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".tif", ".tiff", ".webp"})
OTHER_PHOTOGRAPHS = frozenset(
    {".heic", ".heif", ".avif", ".jxl", ".jp2", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
)
"""What cameras and phones write too, and nothing here reads."""
# Otherwise Pillow tries every format it knows, whatever the file's name, and hands PostScript to Ghostscript.
FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
LARGEST_IMAGE = 100_000_000  # pixels: a header can announce any number, and each takes 25 bytes of memory
LARGE_IMAGE = 500_000  # pixels: about a second per training step on a CPU; larger pictures are reduced
ORIENTATION = 0x0112  # of EXIF data and TIFF files
_BAND = 100_000  # pixels converted at a time


def read_image(path: str | Path) -> tuple[Tensor, Tensor | None]:
    """Read an image file, PNG, JPEG, BMP, TIFF or WebP by its content: colors and alpha, both in [0, 1], float32.

    Colors are (3, H, W); alpha is (H, W), or None if the file has no transparency.

    Convention: alpha is straight, as PNG defines it: the colors are not premultiplied. An orientation tag is ignored,
    as by COLMAP, because the cameras belong to the stored pixels.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is not an image, is damaged, is gray of more than 8 bits, or has more than 100 million
            pixels.
    """
    decoded = decode_image(path)
    width, height = decoded.width, decoded.height
    image = torch.empty(3, height, width)
    alpha = torch.empty(height, width) if decoded.mode == "RGBA" else None
    rows = max(1, _BAND // width)
    for top in range(0, height, rows):
        band = np.array(decoded.crop((0, top, width, min(top + rows, height))))
        channels = torch.from_numpy(band).permute(2, 0, 1).to(torch.float32) / 255
        image[:, top : top + rows] = channels[:3]
        if alpha is not None:
            alpha[top : top + rows] = channels[3]
    return image, alpha


def decode_image(path: str | Path) -> Any:
    """Return an image file, decoded to its end, as a Pillow image, RGBA or RGB; errors as for `read_image`."""
    with opened_image(path) as file:
        mode, width, height = file.mode, file.width, file.height
        file.verify()  # checks a PNG's checksums, which decoding does not
    if mode.startswith(("I", "F")):
        raise ValueError(f"{path} has pixel mode {mode}; convert it to 8 bits per channel first.")
    if width * height > LARGEST_IMAGE:
        raise ValueError(f"{path} has {width}x{height} pixels, more than {LARGEST_IMAGE}; make it smaller first.")
    with opened_image(path) as file:
        if file.format == "TIFF":
            _check_strips(file)
            file.getexif().pop(ORIENTATION, None)  # Pillow turns no other files
        return file.convert("RGBA" if has_alpha(file) else "RGB")


def has_alpha(image: Any) -> bool:
    """Whether a Pillow image has transparency."""
    return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info


def image_size(path: str | Path) -> tuple[int, int]:
    """Return the width and height of an image file, pixels, without decoding it; errors as for `read_image`."""
    with opened_image(path) as file:
        # Of a TIFF with an orientation tag, Pillow has the size after turning it.
        return (file.tag_v2[256], file.tag_v2[257]) if file.format == "TIFF" else (file.width, file.height)


@contextmanager
def opened_image(path: str | Path, formats: tuple[str, ...] = FORMATS) -> Iterator[Any]:
    """Open an image with Pillow; whatever it raises becomes ValueError."""
    from PIL import Image, UnidentifiedImageError

    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no image file {path}.")
    try:
        with Image.open(path, formats=formats) as file:
            yield file
    except UnidentifiedImageError as error:
        raise ValueError(
            f"{path} is not a readable image: its content is none of PNG, JPEG, BMP, TIFF or WebP."
        ) from error
    except Exception as error:  # each of Pillow's decoders raises its own types
        raise ValueError(f"{path} is not a readable image: {error}") from error


def _check_strips(file: Any) -> None:
    """Refuse a TIFF whose strips do not cover it: the rest would be black."""
    extents = [tile[1] or (0, 0, *file.size) for tile in file.tile]
    filled = sum((right - left) * (bottom - top) for left, top, right, bottom in extents)
    if filled < file.width * file.height:
        raise ValueError(f"it holds {filled} of its {file.width}x{file.height} pixels")


def composite(image: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
    """Composite a picture (3, H, W) with straight alpha (H, W) on a plain background (3,)."""
    return image * alpha + background[:, None, None] * (1 - alpha)


def resize_image(image: Tensor, width: int, height: int, mode: str = "bicubic") -> Tensor:
    """Resize a picture (C, H, W) in [0, 1] with an antialiased filter, ``"bicubic"`` or ``"bilinear"``.

    Bicubic is Pillow's default, which the published 3DGS loaders use, without their rounding to 8 bits.
    """
    resized = torch.nn.functional.interpolate(image[None], size=(height, width), mode=mode, antialias=True)[0]
    return resized.clamp(0, 1)


def list_images(folder: Path) -> list[Path]:
    """Return the image files of a folder, sorted by name.

    Raises FileNotFoundError if there is no such folder, ValueError if it holds no images.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no image folder {folder}.")
    files = sorted(filter(is_image, folder.iterdir()))
    if not files:
        raise ValueError(
            f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}); convert others, such as HEIC, first."
        )
    return files


def is_image(path: Path) -> bool:
    """Whether a file is a picture by its name; ``._a.jpg``, which macOS leaves on other file systems, is not."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def photograph_folder(scene: Path, kinds: Collection[str] = IMAGE_SUFFIXES | OTHER_PHOTOGRAPHS) -> Path:
    """Return where the photographs of a folder are: in its ``images``, if files of these kinds are there, else itself.

    The kinds are suffixes; files that begin with a dot do not count.
    """
    images = scene / "images"
    found = images.iterdir() if images.is_dir() else ()
    return images if any(path.suffix.lower() in kinds and path.name[0] != "." for path in found) else scene


def unreadable_photographs(folder: Path) -> list[str]:
    """Return the names of photographs in formats that are not read, such as HEIC, unless a readable copy is beside."""
    read = {file.stem for file in folder.iterdir() if is_image(file)}
    others = [file for file in folder.iterdir() if file.suffix.lower() in OTHER_PHOTOGRAPHS]
    return sorted(file.name for file in others if file.stem not in read and not file.name.startswith("."))


def match_images(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the file of each named image in a folder, possibly of resized copies.

    Files are matched by relative path, else by name without extension, else, if there are as many files as names and
    none has a name in common, by sorted order, which is how the LLFF data set relates ``images_8/image000.png`` to
    ``images/IMG_4026.JPG``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if the names cannot be matched, or one leads out of the folder.
    """
    paths = {name: path_inside(folder, name) for name in names}
    if folder.is_dir() and all(path.is_file() for path in paths.values()):
        return paths
    files = list_images(folder)
    # A Mac takes the accents of names apart.
    by_stem = {normalize("NFC", file.stem): file for file in files}
    stems = {name: normalize("NFC", Path(name).stem) for name in names}
    unique = len(by_stem) == len(files) and len(set(stems.values())) == len(names)  # not so for two folders of cameras
    if unique and by_stem.keys() >= set(stems.values()):
        return {name: by_stem[stem] for name, stem in stems.items()}
    common = by_stem.keys() & set(stems.values()) if unique else set[str]()
    if len(files) == len(names) and not common:
        return dict(zip(sorted(names), files, strict=True))
    missing = [name for name in names if not paths[name].is_file() and stems[name] not in common]
    others = [file.name for stem, file in by_stem.items() if stem not in common]
    raise ValueError(
        f"{folder} lacks {len(missing)} of the {len(names)} images of the scene, such as {missing[:3]}; it holds "
        f"{len(files)} files, such as {(others or [file.name for file in files])[:3]}. Choose another image folder; "
        "photographs that were renamed need their names of before, new ones that their cameras are found anew."
    )


def path_inside(root: str | Path, relative: str) -> Path:
    """Return ``root / relative`` for a path that comes from a file, relative or not, and must not lead out of ``root``.

    Symbolic links are not resolved: a data set may link to pictures elsewhere, but must not name them.

    Raises:
        ValueError: if the path leaves ``root``.

    Example:
        >>> path_inside("scene", "./train/r_2").as_posix()
        'scene/train/r_2'
    """
    normal = os.path.relpath(os.path.join(root, relative), root)
    if normal.split(os.sep)[0] == os.pardir:
        raise ValueError(f"the path {relative!r} leads out of the scene folder {root}; it must stay inside.")
    return Path(root) / normal


def reduction(folder: Path, usual: str = "images") -> int:
    """Return by how much the copies in a folder ``<usual>_<factor>`` are reduced; 0 for one of another name.

    Example:
        >>> reduction(Path("garden/images_4")), reduction(Path("garden/images"))
        (4, 0)
    """
    name, _, factor = folder.name.rpartition("_")
    return int(factor) if name == usual and factor.isdecimal() else 0


def image_folder(root: Path, name: str | None, usual: str = "images") -> Path:
    """Return the folder of a scene's photographs: the named one, or a default.

    The default is the first of ``<usual>`` and the ``<usual>_<factor>`` beside it, by increasing factor, whose pictures
    have at most half a megapixel, else the last of them, folders without pictures left out; without any, the scene
    folder itself if it has pictures.

    Raises:
        FileNotFoundError: if there is none.
    """
    if name is not None:
        found = [root / name] if (root / name).is_dir() else []
    else:
        found = [root / usual] if (root / usual).is_dir() else []
        by_factor = sorted((reduction(path, usual), path) for path in root.iterdir() if path.is_dir())
        found += [path for factor, path in by_factor if factor]
        first, found = found[:1], [path for path in found if any(map(is_image, path.iterdir()))]
        found = found or ([root] if any(map(is_image, root.iterdir())) else first)
    if not found:
        others = sorted(each.name for each in root.iterdir() if each.is_dir() and any(map(is_image, each.iterdir())))
        raise FileNotFoundError(
            f"there is no folder {root / (name or usual)}; the folders of {root} with pictures are {others}: name one "
            "with --images."
        )
    if len(found) == 1:
        return found[0]
    return next((path for path in found if math.prod(image_size(list_images(path)[0])) <= LARGE_IMAGE), found[-1])
