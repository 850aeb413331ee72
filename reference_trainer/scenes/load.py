"""One function that loads any scene: finds the format, the pictures, the split and honest initial points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from reference_trainer.scenes.blender import read_transforms
from reference_trainer.scenes.colmap import COLMAP_FOLDERS, colmap_frames, find_colmap, read_colmap
from reference_trainer.scenes.frames import Frame, load_view
from reference_trainer.scenes.images import is_image
from reference_trainer.scenes.initial_points import choose_points
from reference_trainer.scenes.llff import read_llff
from reference_trainer.scenes.points import check_no_leak
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.splits import blender_split, file_split, llff_split
from reference_trainer.scenes.synthetic import synthetic_scene

__all__ = ["FORMATS", "detect_format", "load_scene"]

logger = logging.getLogger(__name__)

FORMATS = ("synthetic", "blender", "colmap", "llff")
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
DEFAULT_VIEWS = {"synthetic": 3, "blender": 8, "colmap": 3, "llff": 3}  # the paper's protocols


def load_scene(
    path: str | Path,
    *,
    format: str = "auto",
    images: str | None = None,
    views: int | None = None,
    split: str = "auto",
    points: str = "auto",
    downscale: float = 1.0,
    background: str = "auto",
    allow_test_points: bool = False,
    seed: int = 0,
) -> Scene:
    """Load a scene: photographs with cameras, split into training and test views, and initial points.

    Args:
        path: the scene folder, or ``"synthetic"`` for the built-in scene.
        format: ``"blender"`` (``transforms_train.json``), ``"colmap"`` (``sparse/0``, ``sparse`` or the
            folder itself), ``"llff"`` (``poses_bounds.npy``), or ``"auto"`` for the first of these that is there.
        images: the image folder within the scene, such as ``"images_8"``; cameras are scaled to its pictures. By
            default ``images``, else the ``images_<factor>`` with the smallest factor. Not for Blender scenes.
        views: number of training views. By default the split file's own choice, else 3, and 8 for Blender scenes.
        split: ``"llff"`` for the rule of that data set (see ``llff_split``), or the name of a JSON file in the scene
            folder without its extension, such as ``"split_near"`` (see ``file_split``). ``"auto"`` takes ``split.json``
            if there is one, else the LLFF rule. Blender scenes are split by their JSON files (see ``blender_split``).
        points: a COLMAP folder within the scene, such as ``"sparse_3views/0"``, a ``.ply`` file within it, ``"random"``
            or ``"random:<count>"``. ``"auto"`` takes, of the folders ``sparse_*/0`` made from training views alone, the
            one with most points, else random points. It never takes ``sparse/0``, which has seen the test views.
        downscale: factor by which pictures are made smaller, at least 1.
        background: ``"black"`` or ``"white"``, which pictures with transparency are laid on. ``"auto"`` is white for
            Blender scenes, else black.
        allow_test_points: accept points that have seen test views. Results then do not count as sparse-view ones.
        seed: seed of random points, and of the points of the built-in scene.

    Returns:
        The scene, float32 on the CPU; views are in the order of their names, for Blender scenes of their JSON file.

    Raises:
        FileNotFoundError: if a file or folder is missing.
        ValueError: if an option or a file makes no sense, or the points have seen test views.

    Example:
        >>> scene = load_scene("synthetic", downscale=4)
        >>> len(scene.train), len(scene.test), tuple(scene.train[0].image.shape)
        (3, 3, (3, 30, 40))
    """
    if downscale < 1:
        raise ValueError(f"downscale must be at least 1, got {downscale}.")
    if background not in ("auto", *BACKGROUNDS):
        raise ValueError(f"background must be auto, black or white, got {background!r}.")
    format = "synthetic" if str(path) == "synthetic" else detect_format(path) if format == "auto" else format
    if format not in FORMATS:
        raise ValueError(f"format must be auto or one of {', '.join(FORMATS)}, got {format!r}.")
    if views is not None and views < 1:
        raise ValueError(f"views must be at least 1, got {views}.")
    if format == "synthetic":
        _only_default(format, images=images, split=split, points=points, background=background)
        views = views or DEFAULT_VIEWS[format]
        return synthetic_scene(round(160 / downscale), round(120 / downscale), train_views=views, seed=seed)
    root = Path(path)
    if format == "blender":
        _only_default(format, images=images, split=split)
        train, test = _blender_frames(root, views or DEFAULT_VIEWS[format])
    else:
        frames = _photo_frames(root, format, images)
        train, test = _split_frames(root, frames, split, views, DEFAULT_VIEWS[format])
    generator = torch.Generator().manual_seed(seed)
    cloud = choose_points(root, points, train, generator)
    check_no_leak(cloud, [frame.name for frame in train], allow=allow_test_points)
    worst = max(frame.distortion_px for frame in [*train, *test])
    if worst > 0:
        logger.info("%s: lens distortion is ignored; it moves image corners by up to %.2f pixels.", root, worst)
    chosen = background if background != "auto" else "white" if format == "blender" else "black"
    colour: Tensor = torch.tensor(BACKGROUNDS[chosen])
    return Scene(
        name=root.resolve().name,
        train=tuple(load_view(frame, background=colour, downscale=downscale) for frame in train),
        test=tuple(load_view(frame, background=colour, downscale=downscale) for frame in test),
        points=cloud,
        background=colour,
        source=", ".join(sorted({str(frame.path.parent) for frame in [*train, *test]})),
    )


def detect_format(path: str | Path) -> str:
    """Return the format of a scene folder: ``"blender"``, ``"colmap"`` or ``"llff"``, the first whose file is there.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds none of them; the message lists what it holds.
    """
    root = Path(path)
    if not root.is_dir():
        raise FileNotFoundError(f"there is no scene folder {root}; for the built-in scene, say 'synthetic'.")
    if (root / "transforms_train.json").exists():
        return "blender"
    if find_colmap(root) is not None:
        return "colmap"
    if (root / "poses_bounds.npy").exists():
        return "llff"
    raise ValueError(
        f"{root} has none of transforms_train.json, a COLMAP model ({', '.join(COLMAP_FOLDERS)} or the folder itself) "
        f"and poses_bounds.npy; it has {_contents(root)}."
    )


def _blender_frames(root: Path, views: int) -> tuple[list[Frame], list[Frame]]:
    """Read both transforms files and pick their protocol's frames."""
    train = read_transforms(root / "transforms_train.json")
    test = read_transforms(root / "transforms_test.json")
    train_ids, test_ids = blender_split(len(train), len(test), views)
    return [train[i] for i in train_ids], [test[i] for i in test_ids]


def _photo_frames(root: Path, format: str, images: str | None) -> list[Frame]:
    """Read the frames of a scene of photographs in one folder."""
    folder = root / (images or _image_folder(root))
    if not folder.is_dir():
        found = sorted(each.name for each in root.iterdir() if each.is_dir() and any(map(is_image, each.iterdir())))
        raise FileNotFoundError(
            f"there is no folder {folder} (--images); the folders of {root} with pictures are {found}."
        )
    if format == "llff":
        return read_llff(root / "poses_bounds.npy", folder)
    return colmap_frames(read_colmap(find_colmap(root) or root / COLMAP_FOLDERS[0]), folder)


def _image_folder(root: Path) -> str:
    """Find the folder of the largest pictures."""
    factors = {"images": 1}
    for folder in root.glob("images_*"):
        factor = folder.name.removeprefix("images_")
        if factor.isdecimal() and folder.is_dir():
            factors[folder.name] = int(factor)
    for name in sorted(factors, key=lambda name: factors[name]):
        if (root / name).is_dir():
            return name
    raise FileNotFoundError(f"{root} has no folder images or images_<factor>; it has {_contents(root)}. Name one.")


def _split_frames(
    root: Path, frames: Sequence[Frame], split: str, views: int | None, default_views: int
) -> tuple[list[Frame], list[Frame]]:
    """Apply the split rule or file."""
    if split == "auto":
        split = "split" if (root / "split.json").is_file() else "llff"
    if split == "llff":
        train, test = llff_split(len(frames), views or default_views)
    elif (root / f"{split}.json").is_file():
        train, test = file_split(root / f"{split}.json", [frame.name for frame in frames], views)
    else:
        found = sorted(file.stem for file in root.glob("*.json"))
        raise ValueError(f"{root} has no split {split!r}; choose auto, llff or a JSON file of the scene: {found}.")
    return [frames[i] for i in train], [frames[i] for i in test]


def _only_default(format: str, **options: str | None) -> None:
    """Refuse options that this format has no use for."""
    given = {name: value for name, value in options.items() if value not in (None, "auto")}
    if given:
        raise ValueError(f"a {format} scene has no use for {given}; leave them out.")


def _contents(root: Path) -> list[str]:
    """Names in a folder, for error messages."""
    return sorted(entry.name for entry in root.iterdir())[:20]
