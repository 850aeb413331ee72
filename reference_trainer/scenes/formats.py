"""The table of scene formats, and what a format hands over. A new one is a file with a reader, and a line in `load.py`.

Formats outside of this package come by `register_format`, or by name: ``--format my_module:read_my_scene``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ca_reg.registry import imported
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import is_image
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud

__all__ = ["Capture", "Reader", "SceneFormat", "contents", "find_format", "only_default", "register_format"]


@dataclass(frozen=True)
class Capture:
    """What the files of a scene say, before anything is split or loaded.

    Args:
        frames: the photographs with their cameras, in the order in which splits count them.
        test: the held-out ones where the format itself keeps them apart; ``frames`` are then the training ones.
        points: initial points that the files name.
        split: the rule where there is no split file: ``"llff"`` or ``"dtu"``.
        views: the usual number of training views.
        background: ``"black"`` or ``"white"``, behind transparent pictures.
    """

    frames: list[Frame]
    test: list[Frame] | None = None
    points: PointCloud | None = None
    split: str = "llff"
    views: int = 3
    background: str = "black"


Reader = Callable[[Path, SceneOptions], Capture]
"""From a scene folder and what was asked for (``images`` is a reader's business) to what the files say."""


@dataclass(frozen=True)
class SceneFormat:
    """One row of the table.

    Args:
        name: what ``--format`` calls it.
        sign: the file or folder by which it is known, for messages.
        found: whether a folder is one.
        read: its reader.
    """

    name: str
    sign: str
    found: Callable[[Path], bool]
    read: Reader


_FORMATS: dict[str, SceneFormat] = {}


def register_format(format: SceneFormat) -> None:
    """Add a format, after those that are there: of several that a folder fits, the first counts.

    Example:
        >>> found = lambda root: (root / "toy.txt").exists()
        >>> toy = SceneFormat("toy", "toy.txt", found, lambda root, options: Capture([]))
        >>> register_format(toy)
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "toy.txt").write_text("a camera")
        ...     find_format(Path(folder), "auto")[0]
        'toy'
        >>> del _FORMATS["toy"]
    """
    _FORMATS[format.name] = format


def find_format(root: Path, name: str) -> tuple[str, Reader]:
    """Return the name and reader of the format of this name, or of the first that a folder fits, for ``"auto"``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is no such format, or the folder fits none; the message lists what it holds.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"there is no scene folder {root}; for the built-in scene, say 'synthetic'.")
    if ":" in name:
        return name, _imported(name)
    if name == "auto":
        name = next((format.name for format in _FORMATS.values() if format.found(root)), name)
    if name in _FORMATS:
        return name, _FORMATS[name].read
    if name != "auto":
        raise ValueError(f"format must be auto, module:function or one of {', '.join(_FORMATS)}, got {name!r}.")
    if any(map(is_image, (*root.glob("*"), *root.glob("images/*")))):
        raise ValueError(
            f"the photographs in {root} have no cameras yet: `ca-reg poses {root}` finds them (pip install "
            "'ca_reg[colmap]'), as do COLMAP, VGGT and InstantSplat."
        )
    raise ValueError(
        f"{root} has none of {', '.join(format.sign for format in _FORMATS.values())}; it has {contents(root)}."
    )


def _imported(name: str) -> Reader:
    """Return a reader from a module of the user, which may lie in the working directory."""
    module, _, attribute = name.partition(":")
    try:
        reader: Reader = imported(module, attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"format {name!r} must name a function (root, options) -> Capture: {error}.") from error
    return reader


def only_default(format: str, **options: object) -> None:
    """Refuse options that a format has no use for."""
    given = {name: value for name, value in options.items() if value not in (None, "auto")}
    if given:
        raise ValueError(f"a {format} scene has no use for {given}; leave them out.")


def contents(root: Path) -> list[str]:
    """Names in a folder, for error messages."""
    return sorted(entry.name for entry in root.iterdir())[:20]
