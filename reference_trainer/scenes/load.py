"""`load_scene`, which loads any scene: format, pictures, split, and initial points that have not seen test views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from reference_trainer.json_files import read_json
from reference_trainer.render.constants import NEAR_PLANE
from reference_trainer.scenes.colmap import COLMAP
from reference_trainer.scenes.dense import THIN, dense_start, made_unasked
from reference_trainer.scenes.depth import point_prior, true_priors, with_prior
from reference_trainer.scenes.exposure import with_one_exposure
from reference_trainer.scenes.formats import Capture, find_reader, only_default, register_format
from reference_trainer.scenes.frames import Frame, corner_displacement, load_view
from reference_trainer.scenes.images import LARGE_IMAGE, image_size, unreadable_photographs
from reference_trainer.scenes.numpy_formats import ARRAYS, IDR, LLFF
from reference_trainer.scenes.options import BACKGROUNDS, SceneOptions
from reference_trainer.scenes.points import check_no_leak, choose_points, filled, model_start
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.scenes.transforms import BLENDER, TRANSFORMS

__all__ = ["blender_split", "dtu_split", "evenly_spaced", "file_split", "find_reader", "llff_split", "load_scene"]

# The order matters: of several formats that fit a folder, the first counts.
for _format in (BLENDER, IDR, COLMAP, TRANSFORMS, LLFF, ARRAYS):
    register_format(_format)

FEW = 8
"""Below this many photographs all are trained on, unless a split is asked for: there are none to spare."""
BLENDER_TRAIN = (2, 16, 26, 55, 73, 76, 86, 93)  # the 8 views of DietNeRF, adopted by every later paper
BLENDER_TEST_FRAMES = 200  # the size of a full NeRF-synthetic test set
TEST_EVERY = 8
NERFSTUDIO = (
    ("train_filenames", "train"),
    ("train_filenames", "train_all"),
    ("val_filenames", "test"),
    ("test_filenames", "test"),
)
"""nerfstudio's lists, and what a split file calls them; of two for one, the last counts."""
_OTHERS = "Another split, such as 'llff', does without the file, and --test none holds nothing out."
DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)  # PixelNeRF's; a protocol of n views takes the first n
DTU_TEST = (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, *range(29, 36), 41, 42, 43, 45, 46, 47)


def load_scene(options: SceneOptions, *, seed: int = 0, trains: bool = True) -> Scene:
    """Load a scene: photographs with cameras, split into training and test views, and initial points.

    The scene is float32 on the CPU; views are sorted by name, those of Blender scenes in the order of the JSON file.
    The seed is that of random points, and of the points of the built-in scene. A scene that trains nothing (``trains``
    is False), because a model is there already, need not wait for a dense start: it may have few points, or none.

    Raises:
        FileNotFoundError: if a file or folder is missing.
        ValueError: if an option or a file is invalid, the points have seen test views, the world's origin is too far
            from the cameras for float32, or most of what they see is before the near plane.

    Example:
        >>> scene = load_scene(SceneOptions("synthetic", downscale=4))
        >>> len(scene.train), len(scene.test), tuple(scene.train[0].image.shape)
        (3, 3, (3, 30, 40))
    """
    if options.path == "synthetic":
        return _built_in(options, seed)
    root = Path(options.path)
    capture = find_reader(root, options.format)(root, options)
    train, test = _split(root, capture, options)
    frames = [*train, *test]
    _check_origin(frames)
    trained = [frame.name for frame in train]
    # Initial points must come from no photograph that is not trained on, whether it is tested or not.
    held_out = {frame.name for frame in [*capture.frames, *(capture.test or [])]} - set(trained)
    generator = torch.Generator().manual_seed(seed)
    start = None
    if options.init is None:
        cloud, about_points = choose_points(root, options.points, train, held_out, generator, own=capture.points)
    else:
        start, cloud, about_points = model_start(options.init)
    check_no_leak(cloud, trained, held_out, allow=options.allow_test_points)
    chosen = capture.background if options.background == "auto" else options.background
    color: Tensor = torch.tensor(BACKGROUNDS[chosen])
    downscale, about_size = _downscale(frames, options.downscale)
    load = partial(load_view, background=color, downscale=downscale, undistort=options.undistort)
    views, test_views = tuple(map(load, train)), tuple(map(load, test))
    folders = sorted({frame.path.parent for frame in capture.frames})
    unread = [name for folder in folders for name in unreadable_photographs(folder)]
    notes = [
        f"not read: {', '.join(unread)}. Save them as JPEG or PNG, and find their cameras" * bool(unread),
        capture.note,
        about_size,
        _about_lenses(frames, options),
        "masks: scores count what is white in them, training uses the whole photographs"
        * any(frame.mask is not None for frame in frames),
    ]
    if trains:
        if options.points == "dense":
            cloud, about_points = dense_start(views, cloud)
        elif options.points == "auto" and start is None:
            cloud, about_points = _enough_points(cloud, about_points, views, train, generator)
        notes += [about_points, _about_near(views, cloud)]
    if options.one_exposure:
        views, test_views, about_exposure = with_one_exposure(views, test_views, cloud.positions)
        notes.append(about_exposure)
    if options.depth == "points":
        views = tuple(point_prior(view, cloud) for view in views)
    elif options.depth is not None:
        views = tuple(with_prior(view, frame, root, options) for view, frame in zip(views, train, strict=True))
    return Scene(
        name=root.resolve().name,
        train=views,
        test=test_views,
        points=cloud,
        start=start,
        background=color,
        source=", ".join(sorted({str(frame.path.parent) for frame in frames})),
        notes=tuple(filter(None, notes)),
    )


def _enough_points(
    cloud: PointCloud, about: str, views: Sequence[View], train: Sequence[Frame], generator: torch.Generator
) -> tuple[PointCloud, str]:
    """Add to measured points, if they are few, those of a dense start, or random ones where that cannot be."""
    number, fault = len(cloud.positions), ""
    if made_unasked(number, len(views)):
        try:
            cloud, found = dense_start(views, cloud)
            return cloud, found if number else "; ".join(filter(None, (found, about)))
        except (ImportError, ValueError) as error:
            fault = str(error)
    if number < THIN:
        cloud, more = filled(cloud, train, generator)
        about = "; ".join(filter(None, (about, more)))
    return cloud, "; ".join(filter(None, (about, fault)))


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


def _check_origin(frames: list[Frame]) -> None:
    """Refuse cameras so far from the world's origin that float32 blurs their places, as in coordinates of a map."""
    centers = torch.stack([frame.camera.position.double() for frame in frames])
    far, apart = centers.norm(dim=1).max().item(), (centers - centers.mean(0)).norm(dim=1).max().item()
    # Below the first all stand in one place. At the second a center is off by some 0.1 pixels, at a focal length of 300
    # and a depth of five times the distance between the cameras.
    if 1e-9 * far < apart < 3e-5 * far:
        raise ValueError(
            f"the cameras are {far:,.0f} from the origin of the world and {apart:,.3g} from their middle, which single "
            "precision cannot tell well enough: move the origin to them, of points too (pycolmap's "
            "Reconstruction.normalize does)."
        )


def _about_near(views: Sequence[View], cloud: PointCloud) -> str:
    """Return a note on points before the near plane, empty if they are few; refuse a world in which most are."""
    depths = torch.cat([view.camera.depths_of(cloud.positions) for view in views])
    share = float((depths < NEAR_PLANE).float().mean()) if len(depths) else 0.0
    about = (
        f"{share:.0%} of the initial points that the cameras see are nearer than {NEAR_PLANE} units, where nothing is "
        "rendered: make the world larger, cameras and points (pycolmap's Reconstruction.normalize does)"
    )
    if share > 0.5:
        raise ValueError(f"{about}.")
    return about * (share > 0.01)


def _downscale(frames: list[Frame], asked: float | None) -> tuple[float, str]:
    """Return the factor by which pictures are shrunk, and a note if it is not the user's choice."""
    if asked is not None:
        return asked, ""
    width, height = max((image_size(frame.path) for frame in frames), key=math.prod)
    factor = math.sqrt(width * height / LARGE_IMAGE)
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


def evenly_spaced(count: int, views: int) -> list[int]:
    """Choose ``views`` of ``count`` items, evenly spaced, first and last included; a single one is the first.

    Convention: ``np.linspace(0, count - 1, views)`` rounded half to even by ``round``, as in RegNeRF and its followers.

    Raises:
        ValueError: if not ``1 <= views <= count``.

    Example:
        >>> evenly_spaced(17, 3)
        [0, 8, 16]
    """
    if not 1 <= views <= count:
        raise ValueError(f"cannot choose {views} training views from {count}; ask for 1 to {count}.")
    return [round(x) for x in np.linspace(0, count - 1, views).tolist()]


def llff_split(count: int, views: int) -> tuple[list[int], list[int]]:
    """Split the ``count`` images of a forward-facing scene, sorted by name, into training and test indices.

    Every eighth image is a test view, beginning with the first; the training views are spread evenly over the rest.
    Raises ValueError if there are not enough images.

    Example:
        >>> llff_split(20, 3)
        ([1, 10, 19], [0, 8, 16])
    """
    pool = [i for i in range(count) if i % TEST_EVERY]
    if views > len(pool):
        raise ValueError(
            f"cannot choose {views} training views from the {len(pool)} of {count} photographs that are not held out "
            f"(every eighth is, from the first on): ask for 1 to {len(pool)}, or hold none out with --test none."
        )
    return [pool[i] for i in evenly_spaced(len(pool), views)], list(range(0, count, TEST_EVERY))


def dtu_split(count: int, views: int) -> tuple[list[int], list[int]]:
    """Split a DTU scan of 49 or 64 pictures, sorted by name, into training and 25 test indices, as PixelNeRF, RegNeRF.

    Raises ValueError if there are fewer than 49 images, or ``views`` is not 1 to 9.

    Example:
        >>> train, test = dtu_split(49, 3)
        >>> train, len(test)
        ([22, 25, 28], 25)
    """
    if count <= max(DTU_TRAIN) or not 1 <= views <= len(DTU_TRAIN):
        raise ValueError(f"the DTU split takes 1 to 9 views of a scan of 49 pictures or more, got {views} of {count}.")
    return sorted(DTU_TRAIN[:views]), list(DTU_TEST)


def blender_split(train_count: int, test_count: int, views: int) -> tuple[list[int], list[int]]:
    """Choose training and test views of a Blender (NeRF-synthetic) scene: indices into its two JSON files.

    On the full data set the 8-view protocol takes eight fixed training views and every eighth of the 200 test views.
    A scene that lists no more than ``views`` training frames is already subsampled: all are taken. Other numbers of
    views are spread evenly. A test list shorter than 200 is taken whole.

    Raises:
        ValueError: if there is no training frame or ``views`` is not positive.

    Example:
        >>> train, test = blender_split(100, 200, 8)
        >>> train, len(test)
        ([2, 16, 26, 55, 73, 76, 86, 93], 25)
    """
    if views == len(BLENDER_TRAIN) and train_count > max(BLENDER_TRAIN):
        train = list(BLENDER_TRAIN)
    else:
        train = evenly_spaced(train_count, min(views, train_count))
    return train, list(range(0, test_count, TEST_EVERY if test_count >= BLENDER_TEST_FRAMES else 1))


def file_split(path: Path, names: Sequence[str], views: int | None) -> tuple[list[int], list[int]]:
    """Read a split from a JSON file with a list ``test`` and one or more lists of training images.

    With ``views``, the training list is ``train_<views>``, else ``train`` if it has that length, else ``views`` images
    spread evenly over ``train_all``. Without, it is ``train``, else ``train_3``. The lists of nerfstudio's
    ``transforms.json`` will do as well: ``train_filenames`` is ``train`` and ``train_all``, ``test_filenames``, else
    ``val_filenames``, is ``test``. Images are named with or without extension. Returns training and test indices into
    ``names``, all images of the scene, in increasing order.

    Raises:
        ValueError: if a list is missing or repeats an image, names unknown images, or trains on test images.
    """
    content = read_json(path)
    entries = content.items() if isinstance(content, dict) else ()
    lists = {key: value for key, value in entries if isinstance(value, list)}
    lists = {ours: lists[theirs] for theirs, ours in NERFSTUDIO if theirs in lists} | lists
    for key, value in lists.items():
        if key.startswith(("train", "test")) and not all(isinstance(name, str) for name in value):
            raise ValueError(f"{path}: the list {key!r} must hold names of images, strings.")
    train = _training_list(path, lists, views)
    if "test" not in lists:
        raise ValueError(f"{path} has no list 'test'; it has {sorted(lists)}. {_OTHERS}")
    train_ids, test_ids = (_indices(path, chosen, names) for chosen in (train, lists["test"]))
    both = sorted(set(train_ids) & set(test_ids))
    if both:
        raise ValueError(f"{path} uses {[names[i] for i in both]} both to train and to test. {_OTHERS}")
    return train_ids, test_ids


def _training_list(path: Path, lists: dict[str, list[str]], views: int | None) -> list[str]:
    """Pick the training list for this number of views."""
    if views is None:
        chosen = lists.get("train", lists.get("train_3"))
    else:
        chosen = lists.get(f"train_{views}")
        if chosen is None and len(lists.get("train", [])) == views:
            chosen = lists["train"]
        if chosen is None and "train_all" in lists:
            pool = sorted(lists["train_all"])
            chosen = [pool[i] for i in evenly_spaced(len(pool), views)]
    if not chosen:
        found = {key: len(value) for key, value in lists.items() if key.startswith("train")}
        raise ValueError(
            f"{path} lists no training set of {views or 3} views; it has {found}. Add a list 'train_{views or 3}', or "
            "choose another split, such as 'llff'."
        )
    return chosen


def _indices(path: Path, chosen: Sequence[str], names: Sequence[str]) -> list[int]:
    """Find the images by path with or without extension, else by name without extension where that is unambiguous."""
    stems = [PurePosixPath(name).stem for name in names]
    indices = []
    for name in chosen:
        listed = PurePosixPath(name)
        same = [x for x in (name, str(listed), str(listed).removesuffix(listed.suffix)) if x in names]
        if same:
            indices.append(names.index(same[0]))
        elif stems.count(listed.stem) == 1:
            indices.append(stems.index(listed.stem))
        else:
            raise ValueError(
                f"{path} names the image {name!r}; the scene has {list(names)[:4]}... ({len(names)} images)."
            )
    if len(set(indices)) != len(indices):
        raise ValueError(f"{path} names an image twice in one list: {list(chosen)}.")
    return sorted(indices)


RULES = {"llff": llff_split, "dtu": dtu_split}
"""The published splits that go by a photograph's place in the order of names."""
