"""Splits into training and held-out photographs: the published sparse-view protocols."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from reference_trainer.json_files import read_json

__all__ = ["blender_split", "dtu_split", "evenly_spaced", "file_split", "llff_split"]

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


def file_split(path: str | Path, names: Sequence[str], views: int | None) -> tuple[list[int], list[int]]:
    """Read a split from a JSON file with a list ``test`` and one or more lists of training images.

    With ``views``, the training list is ``train_<views>``, else ``train`` if it has that length, else ``views`` images
    spread evenly over ``train_all``. Without, it is ``train``, else ``train_3``. The lists of nerfstudio's
    ``transforms.json`` will do as well: ``train_filenames`` is ``train`` and ``train_all``, ``test_filenames``, else
    ``val_filenames``, is ``test``. Images are named with or without extension. Returns training and test indices into
    ``names``, all images of the scene, in increasing order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a list is missing or repeats an image, names unknown images, or trains on test images.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no split file {path}.")
    content = read_json(path)
    lists = (
        {key: value for key, value in content.items() if isinstance(value, list)} if isinstance(content, dict) else {}
    )
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
