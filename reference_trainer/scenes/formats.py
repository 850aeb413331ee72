"""The table of scene formats and the `Capture` that their readers return.

A new format is a module with a reader and an entry in `load.py`. Formats from outside this package are added by
`register_format`, or named on the command line: ``--format my_module:read_my_scene``.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ca_reg.registry import imported
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import is_image
from reference_trainer.scenes.options import SceneOptions, check_scene
from reference_trainer.scenes.scene import PointCloud

__all__ = [
    "FORMATS", "Capture", "Reader", "SceneFormat", "camera_files", "find_reader", "only_default", "register_format",
]  # fmt: skip


@dataclass(frozen=True)
class Capture:
    """What the files of a scene say, before views are split and pictures loaded.

    Args:
        frames: the photographs with their cameras, in the order that split rules index.
        test: the held-out frames if the format itself keeps them apart; ``frames`` are then the training ones.
        points: initial points that the files name.
        split: the rule where there is no split file: ``"llff"``, ``"dtu"``, or the name of a JSON file of the scene
            that holds lists as a split file does.
        views: the default number of training views.
        background: ``"black"`` or ``"white"``, behind transparent pictures.
        note: what a user should know.

    Raises:
        ValueError: if there are no frames.
    """

    frames: list[Frame]
    test: list[Frame] | None = None
    points: PointCloud | None = None
    split: str = "llff"
    views: int = 3
    background: str = "black"
    note: str = ""

    def __post_init__(self) -> None:
        if not self.frames:
            raise ValueError("the scene has no photograph with a camera: its file of cameras lists none.")


Reader = Callable[[Path, SceneOptions], Capture]
"""Reads a scene folder; of the options, ``images`` is for the reader to honor."""


@dataclass(frozen=True)
class SceneFormat:
    """One row of the table.

    Args:
        name: what ``--format`` calls it.
        sign: the file or folder that identifies it, for messages.
        found: whether a folder holds a scene of this format.
        read: its reader.
    """

    name: str
    sign: str
    found: Callable[[Path], bool]
    read: Reader


FORMATS: dict[str, SceneFormat] = {}
"""By name, in the order in which a folder is tried."""


def register_format(format: SceneFormat) -> None:
    """Add a format after the existing ones; of several that fit a folder, the first counts.

    Example:
        >>> found = lambda root: (root / "toy.txt").exists()
        >>> toy = SceneFormat("toy", "toy.txt", found, lambda root, options: Capture([]))
        >>> register_format(toy)
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "toy.txt").write_text("a camera")
        ...     find_reader(Path(folder), "auto") is toy.read
        True
        >>> del FORMATS["toy"]
    """
    FORMATS[format.name] = format


def find_reader(root: Path, name: str) -> Reader:
    """Return the reader of the named format, or for ``"auto"`` of the first that fits the folder.

    ``module:function`` names a user's own, whose module may lie in the working directory.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is no such format, or none fits the folder.
    """
    check_scene(root)
    module, colon, function = name.partition(":")
    if colon:
        try:
            reader: Reader = imported(module, function)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"format {name!r} must name a function (root, options) -> Capture: {error}.") from error
        return reader
    if name == "auto":
        name = next((format.name for format in FORMATS.values() if format.found(root)), name)
    if name in FORMATS:
        return FORMATS[name].read
    if name != "auto":
        raise ValueError(f"format must be auto, module:function or one of {', '.join(FORMATS)}, got {name!r}.")
    if any(map(is_image, (*root.glob("*"), *root.glob("images/*")))):
        raise ValueError(
            f"the photographs in {root} have no cameras yet: `ca-reg poses {shlex.quote(str(root))}` finds them (pip "
            "install 'ca_reg[colmap]'), as do COLMAP, VGGT and InstantSplat."
        )
    raise ValueError(
        f"{root} has none of {', '.join(format.sign for format in FORMATS.values())}; it has "
        f"{', '.join(sorted(entry.name for entry in root.iterdir())[:20]) or 'nothing'}."
    )


def only_default(format: str, **options: object) -> None:
    """Refuse options that a format ignores, unless they have their defaults."""
    given = {name: value for name, value in options.items() if value not in (None, "auto")}
    if given:
        raise ValueError(f"a {format} scene has no use for {given}; leave them out.")


def camera_files(root: Path) -> list[Path]:
    """Return the files of a scene folder from which cameras are read, of the usual formats."""
    colmap = [
        f"{place}{name}.{kind}"
        for place in ("", "sparse*/**/")
        for name in ("cameras", "images")
        for kind in ("bin", "txt")
    ]
    kinds = (*colmap, "transforms*.json", "poses_bounds.npy", "cameras*.npz")
    return sorted(path for kind in kinds for path in root.glob(kind) if path.is_file())
