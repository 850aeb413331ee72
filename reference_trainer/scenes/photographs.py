"""Photographs as people have them, of a camera or a phone, made into a folder of pictures that COLMAP reads."""

from __future__ import annotations

import filecmp
import logging
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from reference_trainer.files import replacing
from reference_trainer.scenes.images import (
    FORMATS,
    IMAGE_SUFFIXES,
    ORIENTATION,
    OTHER_PHOTOGRAPHS,
    decode_image,
    has_alpha,
    opened_image,
    photograph_folder,
    reduction,
)

__all__ = ["collect_photographs", "is_video", "sharpest_frames", "sort_photographs", "unread_folders"]

HEIC = frozenset({".heic", ".heif"})
VIDEOS = frozenset(
    {".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".wmv", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".3g2"}
)
_KINDS = IMAGE_SUFFIXES | OTHER_PHOTOGRAPHS | VIDEOS
_AS_THEY_ARE = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".png"})  # what COLMAP reads
_COPIES = dict.fromkeys(OTHER_PHOTOGRAPHS, _AS_THEY_ARE) | {".mov": _AS_THEY_ARE | HEIC}
"""What cameras and phones write of one photograph under one name: these kinds of files beside those."""
_BESIDE = frozenset(
    {".aae", ".xmp", ".pp3", ".thm", ".lrv", ".db", ".ini", ".txt", ".json", ".csv", ".xml", ".md"}
    | {".bin", ".ply", ".npy", ".npz"}
)
"""What programs keep beside photographs, and what scenes are made of: nobody takes them for photographs."""
_CAMERA, _LENS, _FOCAL = (0x010F, 0x0110), 0x8769, (0x920A, 0xA405)
"""EXIF: make and model; the group of tags, and of these the focal lengths, from which COLMAP knows that in pixels."""
_JUDGED = 640  # pixels of the longer side at which sharpness is judged
_log = logging.getLogger(__name__)


def is_video(path: Path) -> bool:
    """Whether a file is a video by its name."""
    return path.suffix.lower() in VIDEOS


def sort_photographs(source: Path) -> tuple[list[Path], dict[str, str]]:
    """Return the photographs and videos that can be read, and by name the others with what is wrong with them.

    ``source`` is a folder with the files, or with a folder ``images`` of them, or one video. Every photograph is
    decoded to its end. One that is there twice is taken once: of equal files the others are named, and what a phone or
    a camera writes of one photograph, such as IMG_1.HEIC and IMG_1.MOV beside IMG_1.JPG, needs no word, nor do hidden
    files and those that programs keep beside photographs.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ImportError: if photographs or videos are there that need ca_reg[photos].
    """
    folder = photograph_folder(source, _KINDS)
    files = [source] if source.is_file() else [path for path in folder.iterdir() if path.is_file()]
    # Of what is there twice, the first choice comes first.
    files.sort(key=lambda path: (path.suffix.lower() not in _AS_THEY_ARE, is_video(path), path.stem, path))
    usable, wrong = list[Path](), dict[str, str]()
    of_size, of_stem = defaultdict[int, list[Path]](list), defaultdict[str, set[str]](set)
    for path in files:
        kind = path.suffix.lower()
        if path.name.startswith(".") or kind in _BESIDE or of_stem[path.stem] & _COPIES.get(kind, frozenset()):
            continue
        try:
            alike = of_size[path.stat().st_size]
            if same := next((other for other in alike if filecmp.cmp(path, other, shallow=False)), None):
                raise ValueError(f"{path.name} is the same file as {same.name}")
            if is_video(path):
                _check_video(path)
            elif kind in HEIC:
                _upright(path)
            elif kind in IMAGE_SUFFIXES:
                decode_image(path)
            else:
                unsure = "" if kind in OTHER_PHOTOGRAPHS else ", if it is a photograph"
                raise ValueError(f"{kind[1:].upper() or 'this'} is not read: save it as JPEG or PNG{unsure}")
            usable.append(path)
            alike.append(path)
            of_stem[path.stem].add(kind)
        except (ValueError, OSError) as error:
            wrong[path.name] = str(error)
    return sorted(usable), wrong


def unread_folders(source: Path, own: Path) -> dict[str, str]:
    """Return what to do about photographs, down to two levels, that `sort_photographs` does not read, by folder.

    Only their owner knows which are of one place. What lies in ``own``, the folder of a run, is called masks or holds
    reduced copies of those that are read, is no photograph.
    """
    read = photograph_folder(source, _KINDS)
    found = (path for pattern in ("*", "*/*", "*/*/*") for path in source.glob(pattern) if path.parent != read)
    shown = (path for path in found if not any(part[0] == "." for part in path.relative_to(source).parts))
    held = Counter(
        path.parent
        for path in shown
        if path.suffix.lower() in _KINDS
        and path.is_file()
        and not path.resolve().is_relative_to(own.resolve())
        and path.parent.name.lower() not in ("mask", "masks")
        and not reduction(path.parent, read.name)
    )
    return {
        str(folder): f"photographs or videos in {folder} are not read ({number}): move them to {read}"
        + ", or give their folder instead" * (folder != source)
        for folder, number in held.items()
    }


def collect_photographs(sources: Sequence[Path], folder: Path, frames: int = 16) -> list[str]:
    """Write photographs and frames of videos, of `sort_photographs`, to a folder, upright; return the names there.

    JPEG and PNG files are copied as they are unless an orientation tag turns them; all others become JPEG, or PNG where
    they are transparent, with their EXIF data, of which COLMAP uses the focal length. Of each video so many ``frames``
    are taken, the sharpest in as many equal parts of its duration. No two names differ in their endings or case alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names, taken = list[str](), set[str]()

    def place(stem: str, suffix: str) -> Path:
        """Return where to write a picture, under a name of its own."""
        stem = next(x for x in chain([stem], (f"{stem}_{n}" for n in count(2))) if x.casefold() not in taken)
        taken.add(stem.casefold())
        names.append(f"{stem}{suffix}")
        return folder / names[-1]

    for path in sources:
        if is_video(path):
            _log.info("%s: looking for the sharpest frame of each of %d parts", path.name, frames)
            for number, image in enumerate(sharpest_frames(path, frames)):
                _save(image, place(f"{path.stem}_{number:04d}", ".jpg"))
        elif (turned := _upright(path)) is None:
            with replacing(place(path.stem, path.suffix)) as copy:
                shutil.copyfile(path, copy)
        else:
            _save(turned, place(path.stem, ".png" if turned.mode == "RGBA" else ".jpg"))
    return names


def sharpest_frames(path: Path, count: int) -> Iterator[Any]:
    """Yield of each of ``count`` equal parts of a video the sharpest frame, as a Pillow image, upright.

    Sharpness is the variance of the Laplacian of the gray frame, at most 640 pixels wide.

    Raises:
        ValueError: if the file is no video or is damaged.
        ImportError: if PyAV is missing.
    """
    # From its packets: a header may say nothing of the duration, and time need not begin at 0.
    with _opened_video(path) as file:
        shown = ((p.dts if p.pts is None else p.pts, p.time_base) for p in file.demux(video=0))
        times = [float(time * base) for time, base in shown if time is not None and base is not None] or [0.0]
    first, length = min(times), max(times) - min(times)
    with _opened_video(path) as file:
        stream = file.streams.video[0]
        stream.thread_type = "AUTO"
        part, best, sharpest = 0, None, -1.0
        for frame in file.decode(stream):
            now = min(count - 1, int(count * ((frame.time or 0.0) - first) / length)) if length else 0
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


def _check_video(path: Path) -> None:
    """Refuse a video without a picture that can be decoded; errors are those of `sharpest_frames`."""
    with _opened_video(path) as file:
        try:
            first = next(file.decode(video=0), None)
        except (ValueError, OSError) as error:
            raise ValueError(f"it is not a readable video: {error}") from error
    if first is None:
        raise ValueError("it holds no pictures")


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
        if kind in _AS_THEY_ARE and image.getexif().get(ORIENTATION, 1) == 1:
            return None
        turned = image.convert("RGBA" if has_alpha(image) else "RGB")
        if image.format == "TIFF":  # whose EXIF data, among others, are tags of the file, too many for a JPEG
            tags, kept = image.getexif(), turned.getexif()
            kept.update((tag, tags[tag]) for tag in _CAMERA if tag in tags)
            of_lens = tags.get_ifd(_LENS)
            kept.get_ifd(_LENS).update((tag, of_lens[tag]) for tag in _FOCAL if tag in of_lens)
            turned.info["exif"] = kept.tobytes()
        return ImageOps.exif_transpose(turned)


def _save(image: Any, path: Path) -> None:
    """Write a picture as JPEG or PNG, with its EXIF data."""
    exif = image.getexif()
    exif.pop(ORIENTATION, None)
    with replacing(path) as place:
        image.save(place, "PNG" if path.suffix == ".png" else "JPEG", quality=95, exif=exif)
