"""Scenes: photographs with cameras and initial points, read from one of the `formats` or built in.

``load_scene`` is the entry point; ``Scene`` is all that the rest of the program sees. Names are imported on first
access, so that the command line can list the options of a scene without importing torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reference_trainer.scenes.formats import Capture, SceneFormat, register_format
    from reference_trainer.scenes.frames import Frame
    from reference_trainer.scenes.load import load_scene
    from reference_trainer.scenes.options import SceneOptions
    from reference_trainer.scenes.points import check_no_leak
    from reference_trainer.scenes.scene import PointCloud, Scene, View
    from reference_trainer.scenes.synthetic import synthetic_scene

__all__ = [
    "Capture", "Frame", "PointCloud", "Scene", "SceneFormat", "SceneOptions", "View", "check_no_leak", "load_scene",
    "register_format", "synthetic_scene",
]  # fmt: skip

_MODULES = {
    "Capture": "formats",
    "SceneFormat": "formats",
    "register_format": "formats",
    "Frame": "frames",
    "load_scene": "load",
    "SceneOptions": "options",
    "check_no_leak": "points",
    "PointCloud": "scene",
    "Scene": "scene",
    "View": "scene",
    "synthetic_scene": "synthetic",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
