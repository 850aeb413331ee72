"""Photographs as people have them, of a camera or a phone, made into a folder of pictures that COLMAP reads."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from reference_trainer.files import replacing
from reference_trainer.scenes.images import FORMATS, OTHER_PHOTOGRAPHS, decode_image, is_image, opened_image

__all__ = ["collect_photographs", "is_video", "sharpest_frames", "sort_photographs"]

HEIC = frozenset({".heic", ".heif"})
VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi"})
_AS_THEY_ARE = frozenset({".jpg", ".jpeg", ".png"})  # what COLMAP reads
_ORIENTATION = 0x0112  # EXIF
_JUDGED = 640  # pixels of the longer side at which sharpness is judged


def is_video(path: Path) -> bool:
    """Whether a file is a video by its name."""
    return path.suffix.lower() in VIDEOS


def sort_photographs(source: Path) -> tuple[list[Path], dict[str, str]]:
    """Return the photographs and videos that can be read, and by name the others with what is wrong with them.

    ``source`` is a folder with the files, or with a folder ``images`` of them, or one video. Every photograph is
    decoded to its end. One that is there twice, as a phone exports IMG_1.HEIC beside IMG_1.JPG, is taken once.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ImportError: if photographs or videos are there that need ca_reg[photos].
    """
    if not source.exists():
        raise FileNotFoundError(f"there is no folder {source}: give the folder of the photographs, or a video.")
    folder = source / "images" if (source / "images").is_dir() else source
    files = [source] if source.is_file() else sorted(path for path in folder.iterdir() if path.name[0] != ".")
    files.sort(key=lambda path: path.suffix.lower() not in _AS_THEY_ARE)  # first choice of one that is there twice
    usable, wrong = dict[str, Path](), dict[str, str]()
    for path in files:
        kind = path.suffix.lower()
        if path.is_dir() or path.stem in usable:
            continue
        try:
            if is_video(path):
                _opened_video(path).close()
            elif kind in HEIC:
                _upright(path)
            elif is_image(path):
                decode_image(path)
            elif kind in OTHER_PHOTOGRAPHS:
                raise ValueError(f"{kind[1:].upper()} is not read: save it as JPEG or PNG")
            else:
                continue
            usable[path.stem] = path
        except (ValueError, OSError) as error:
            wrong[path.name] = str(error)
    return sorted(usable.values()), wrong


def collect_photographs(sources: Sequence[Path], folder: Path, frames: int = 16) -> list[str]:
    """Write photographs and frames of videos, of `sort_photographs`, to a folder, upright; return the names there.

    JPEG and PNG files are copied as they are unless an orientation tag turns them; all others become JPEG, with their
    EXIF data, of which COLMAP uses the focal length. Of each video so many ``frames`` are taken, the sharpest in as
    many equal parts of its duration.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for path in sources:
        if is_video(path):
            for number, image in enumerate(sharpest_frames(path, frames)):
                names.append(f"{path.stem}_{number:04d}.jpg")
                _save(image, folder / names[-1])
        elif (turned := _upright(path)) is None:
            names.append(path.name)
            with replacing(folder / path.name) as place:
                shutil.copyfile(path, place)
        else:
            names.append(f"{path.stem}.jpg")
            _save(turned, folder / names[-1])
    return names


def sharpest_frames(path: Path, count: int) -> Iterator[Any]:
    """Yield of each of ``count`` equal parts of a video the sharpest frame, as a Pillow image, upright.

    Sharpness is the variance of the Laplacian of the gray frame, at most 640 pixels wide.

    Raises:
        ValueError: if the file is no video or is damaged.
        ImportError: if PyAV is missing.
    """
    with _opened_video(path) as file:
        stream = file.streams.video[0]
        stream.thread_type = "AUTO"
        length = float((stream.duration or 0) * (stream.time_base or 0)) or (file.duration or 0) / 1e6
        part, best, sharpest = 0, None, -1.0
        for frame in file.decode(stream):
            now = min(count - 1, int(count * (frame.time or 0.0) / length)) if length else 0
            if now > part and best is not None:
                yield _of_video(best)
                part, best, sharpest = now, None, -1.0
            scale = min(1.0, _JUDGED / max(frame.width, frame.height))
            small = frame.reformat(max(3, int(scale * frame.width)), max(3, int(scale * frame.height)), "gray")
            if (sharp := _sharpness(small.to_ndarray())) > sharpest:
                best, sharpest = frame, sharp
        if best is not None:
            yield _of_video(best)


def _sharpness(gray: np.ndarray) -> float:
    """Return the variance of the Laplacian of a picture (H, W)."""
    x = gray.astype(np.float32)
    laplacian = x[:-2, 1:-1] + x[2:, 1:-1] + x[1:-1, :-2] + x[1:-1, 2:] - 4 * x[1:-1, 1:-1]
    return float(laplacian.var())


def _of_video(frame: Any) -> Any:
    """Return a frame as a Pillow image, turned as its video says."""
    return frame.to_image().rotate(getattr(frame, "rotation", 0), expand=True)


def _opened_video(path: Path) -> Any:
    """Open a video; whatever the decoder raises becomes ValueError."""
    try:
        import av
    except ImportError as error:
        raise ImportError(f"{path.name} is a video, which needs PyAV: pip install 'ca_reg[photos]'.") from error
    try:
        file = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise ValueError(f"it is not a readable video: {error}") from error
    if not file.streams.video:
        file.close()
        raise ValueError("it holds no pictures")
    return file


def _upright(path: Path) -> Any:
    """Return a photograph as a Pillow image, turned as its EXIF data say; None where the file will do as it is."""
    from PIL import ImageOps

    kind = path.suffix.lower()
    if kind in HEIC:
        try:
            import pi_heif
        except ImportError as error:
            raise ImportError(f"{path.name} needs pi-heif: pip install 'ca_reg[photos]'.") from error
        pi_heif.register_heif_opener()
    with opened_image(path, ("HEIF",) if kind in HEIC else FORMATS) as image:
        if kind in _AS_THEY_ARE and image.getexif().get(_ORIENTATION, 1) == 1:
            return None
        return ImageOps.exif_transpose(image.convert("RGB"))


def _save(image: Any, path: Path) -> None:
    """Write a picture as JPEG, with its EXIF data."""
    exif = image.getexif()
    with suppress(KeyError):
        del exif[_ORIENTATION]
    with replacing(path) as place:
        image.save(place, "JPEG", quality=95, exif=exif)
