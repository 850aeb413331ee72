"""Scenes from COLMAP reconstructions, binary or text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reference_trainer.scenes._colmap_model import READERS, ColmapModel, PointRecords
from reference_trainer.scenes.formats import Capture, SceneFormat
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import image_folder, list_images, match_images
from reference_trainer.scenes.options import SceneOptions

__all__ = ["COLMAP", "colmap_folders", "colmap_frames", "is_colmap", "read_colmap"]

_NAMED = 5  # photographs without a camera


def read_colmap(folder: str | Path) -> ColmapModel:
    """Read a reconstruction, often ``sparse/0``: cameras, images and points, each ``.bin`` or, failing that, ``.txt``.

    The points are empty if the folder has InstantSplat's ``points3D.ply`` instead.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is truncated, inconsistent or not COLMAP's; the message names it.
    """
    folder = Path(folder)
    cameras, images = _read(folder, "cameras"), _read(folder, "images")
    instantsplat = not _has(folder, "points3D") and (folder / "points3D.ply").is_file()
    points = PointRecords().finish() if instantsplat else _read(folder, "points3D")
    try:
        return ColmapModel(cameras, tuple(sorted(images, key=lambda image: image.name)), points)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error


def colmap_folders(root: Path) -> list[Path]:
    """Return the folders of a scene that hold a reconstruction; cameras are read from the first.

    Candidates, in order: ``sparse/0`` (COLMAP), ``sparse`` (VGGT), the scene folder itself, and every
    ``sparse_<name>/0`` (InstantSplat, and clouds from the training views alone).
    """
    folders = [root / "sparse" / "0", root / "sparse", root, *sorted(root.glob("sparse_*/0"))]
    return list(filter(is_colmap, folders))


def is_colmap(folder: Path) -> bool:
    """Whether a folder holds the cameras and images of a reconstruction."""
    return _has(folder, "cameras") and _has(folder, "images")


def colmap_frames(model: ColmapModel, folder: Path) -> list[Frame]:
    """Pair the images of a reconstruction with their files in a folder, possibly of resized copies; sorted by name.

    Each frame holds the pinhole part of its camera and, separately, the distortion.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if images are missing there, or a camera model is a fisheye.
    """
    files = match_images(folder, [image.name for image in model.images])
    frames = []
    for image in model.images:
        camera = model.cameras[image.camera_id]
        pose = camera.at(image.world_to_camera)
        frames.append(Frame(image.name, files[image.name], pose, camera.distortion))
    return frames


def _read(folder: Path, stem: str) -> Any:
    """Read one of the three files, binary or else text."""
    for suffix, reader in READERS[stem].items():
        path = folder / (stem + suffix)
        if path.is_file():
            try:
                return reader(path)
            except ValueError as error:
                raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error
    found = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else "no such folder"
    raise FileNotFoundError(f"there is no {stem}.bin or {stem}.txt in {folder}; found: {found}.")


def _has(folder: Path, stem: str) -> bool:
    """Whether one of the three files exists in either form."""
    return any((folder / (stem + suffix)).is_file() for suffix in READERS[stem])


def _read_scene(root: Path, options: SceneOptions) -> Capture:
    """Read a scene folder."""
    folder = (colmap_folders(root) or [root / "sparse" / "0"])[0]  # the fallback's error says what is missing
    frames = colmap_frames(read_colmap(folder), image_folder(root, options.images))
    placed = {frame.path for frame in frames}  # maybe in folders of their own, one for each camera
    beside = (path for folder in sorted({path.parent for path in placed}) for path in list_images(folder))
    others = [path.name for path in beside if path not in placed]
    shown = ", ".join([*others[:_NAMED], *["..."] * (len(others) > _NAMED)])
    return Capture(frames, note=f"no camera, and not used: {shown}" * bool(others))


COLMAP = SceneFormat(
    "colmap",
    "a COLMAP model (cameras and images, .bin or .txt, in sparse/0, sparse, sparse_*/0 or the folder itself)",
    lambda root: (root / "sparse" / "0").is_dir() or bool(colmap_folders(root)),
    _read_scene,
)
