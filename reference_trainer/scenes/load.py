"""`load_scene`, which loads any scene: format, pictures, split, and initial points that have not seen test views."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from reference_trainer.scenes.arrays import ARRAYS
from reference_trainer.scenes.colmap import COLMAP
from reference_trainer.scenes.dense import dense_start
from reference_trainer.scenes.depth import point_prior, true_priors, with_prior
from reference_trainer.scenes.formats import Capture, find_format, only_default, register_format
from reference_trainer.scenes.frames import Frame, load_view
from reference_trainer.scenes.idr import IDR
from reference_trainer.scenes.images import LARGE_PICTURE, image_size
from reference_trainer.scenes.llff import LLFF
from reference_trainer.scenes.options import BACKGROUNDS, SceneOptions
from reference_trainer.scenes.points import check_no_leak, choose_points, filled, model_start
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.splits import blender_split, dtu_split, evenly_spaced, file_split, llff_split
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.scenes.transforms import BLENDER, TRANSFORMS
from reference_trainer.scenes.undistort import corner_displacement

__all__ = ["load_options", "load_scene"]

# The order matters: of several formats that fit a folder, the first counts.
for _format in (BLENDER, IDR, COLMAP, TRANSFORMS, LLFF, ARRAYS):
    register_format(_format)

RULES = {"llff": llff_split, "dtu": dtu_split}
FEW = 8
"""Below this many photographs all are trained on, unless a split is asked for: there are none to spare."""


def load_scene(path: str | Path, *, seed: int = 0, **options: Any) -> Scene:
    """Load a scene: photographs with cameras, split into training and test views, and initial points.

    Args:
        path: the scene folder, or ``"synthetic"`` for the built-in scene.
        seed: seed of random points, and of the points of the built-in scene.
        options: the fields of `SceneOptions`.

    Returns:
        The scene, float32 on the CPU; views are sorted by name, those of Blender scenes in the order of the JSON file.

    Raises:
        FileNotFoundError: if a file or folder is missing.
        ValueError: if an option or a file is invalid, or the points have seen test views.

    Example:
        >>> scene = load_scene("synthetic", downscale=4)
        >>> len(scene.train), len(scene.test), tuple(scene.train[0].image.shape)
        (3, 3, (3, 30, 40))
    """
    return load_options(SceneOptions(str(path), **options), seed)


def load_options(options: SceneOptions, seed: int = 0) -> Scene:
    """Load the scene that options describe, as `load_scene` does."""
    if options.path == "synthetic":
        return _built_in(options, seed)
    root = Path(options.path)
    _, read = find_format(root, options.format)
    capture = read(root, options)
    train, test = _split(root, capture, options)
    generator = torch.Generator().manual_seed(seed)
    start = None
    if options.init is None:
        cloud, about_points = choose_points(root, options.points, train, generator, own=capture.points)
    else:
        start, cloud, about_points = model_start(options.init)
    check_no_leak(cloud, [frame.name for frame in train], allow=options.allow_test_points)
    chosen = capture.background if options.background == "auto" else options.background
    color: Tensor = torch.tensor(BACKGROUNDS[chosen])
    downscale, about_size = _downscale([*train, *test], options.downscale)
    load = partial(load_view, background=color, downscale=downscale, undistort=options.undistort)
    views = {"train": tuple(map(load, train)), "test": tuple(map(load, test))}
    if options.points == "dense":
        cloud, about_points = dense_start(views["train"], cloud)
    if options.depth == "points":
        views["train"] = tuple(point_prior(view, cloud) for view in views["train"])
    elif options.depth is not None:
        views["train"] = tuple(
            with_prior(view, frame, root, options) for view, frame in zip(views["train"], train, strict=True)
        )
    about_more = about_masks = ""
    if options.points == "auto" and start is None:
        cloud, about_more = filled(cloud, train, generator)
    if any(frame.mask is not None for frame in [*train, *test]):
        about_masks = "masks: scores count what is white in them, training uses the whole photographs"
    about_lenses = _about_lenses([*train, *test], options)
    return Scene(
        name=root.resolve().name,
        **views,
        points=cloud,
        start=start,
        background=color,
        source=", ".join(sorted({str(frame.path.parent) for frame in [*train, *test]})),
        notes=tuple(filter(None, (about_size, about_lenses, about_masks, about_points, about_more))),
    )


def _built_in(options: SceneOptions, seed: int) -> Scene:
    """Make the built-in scene."""
    points = None if options.points == "dense" else options.points
    only_default("synthetic", images=options.images, split=options.split, points=points, background=options.background)
    downscale = options.downscale or 1.0
    width, height = (max(1, round(side / downscale)) for side in (160, 120))
    scene = synthetic_scene(width, height, train_views=options.views or 3, seed=seed)
    scene = scene if options.test == "auto" else replace(scene, test=())
    if options.init is not None:
        start, cloud, note = model_start(options.init)
        scene = replace(scene, start=start, points=cloud, notes=(note,))
    elif options.points == "dense":
        cloud, note = dense_start(scene.train, scene.points)
        scene = replace(scene, points=cloud, notes=(note,))
    return scene if options.depth is None else true_priors(scene, options.depth)


def _split(root: Path, capture: Capture, options: SceneOptions) -> tuple[list[Frame], list[Frame]]:
    """Apply the split rule or file."""
    frames, test, split = capture.frames, capture.test or [], options.split
    if split == "auto":
        split = "split" if (root / "split.json").is_file() else capture.split
        few = split in RULES and options.views in (None, len(frames)) and capture.test is None and len(frames) < FEW
    else:
        few = False
    if options.test == "none" or few:
        return [frames[i] for i in evenly_spaced(len(frames), options.views or len(frames))], []
    views = options.views or capture.views
    if capture.test is not None:
        train_ids, test_ids = blender_split(len(frames), len(test), views)
        return [frames[i] for i in train_ids], [test[i] for i in test_ids]
    if split in RULES:
        train_ids, test_ids = RULES[split](len(frames), views)
    elif (root / f"{split}.json").is_file():
        train_ids, test_ids = file_split(root / f"{split}.json", [frame.name for frame in frames], options.views)
    else:
        found = sorted(file.stem for file in root.glob("*.json"))
        raise ValueError(
            f"{root} has no split {split!r}; choose auto, {', '.join(RULES)} or a JSON file of the scene: {found}."
        )
    return [frames[i] for i in train_ids], [frames[i] for i in test_ids]


def _downscale(frames: list[Frame], asked: float | None) -> tuple[float, str]:
    """Return the factor by which pictures are shrunk, and a note if it is not the user's choice."""
    if asked is not None:
        return asked, ""
    width, height = max((image_size(frame.path) for frame in frames), key=math.prod)
    factor = math.sqrt(width * height / LARGE_PICTURE)
    if factor <= 1:
        return 1.0, ""
    return factor, (
        f"photographs of {width}x{height} are made smaller by {factor:.2f}, to half a megapixel, which a processor "
        "trains in reasonable time: --downscale 1 takes them as they are"
    )


def _about_lenses(frames: list[Frame], options: SceneOptions) -> str:
    """Return a note on the size of the lens distortion, empty if there is none."""
    worst = max(
        (corner_displacement(frame.camera, frame.distortion) for frame in frames if frame.distortion), default=0.0
    )
    if worst == 0:
        return ""
    size = f"lens distortion, up to {worst:.2f} pixels at a corner of the pictures that the cameras are for,"
    return f"{size} is undone (--no-undistort leaves it in)" if options.undistort else f"{size} is left in, as asked"
