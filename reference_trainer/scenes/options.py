"""How a scene is to be loaded, as one value: what the command line asks for and what workers receive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.scene import Scene

__all__ = ["SceneOptions"]


@dataclass(frozen=True)
class SceneOptions:
    """Which photographs, cameras and points to use.

    Example:
        >>> SceneOptions("synthetic").load(seed=0).name
        'synthetic'
    """

    path: str = "synthetic"
    """Scene folder (COLMAP, LLFF or Blender files), or "synthetic" for the built-in scene."""
    format: str = "auto"
    """"blender", "colmap", "llff", or "auto" to find out."""
    images: str | None = None
    """Image folder within the scene, such as images_8; the cameras are scaled to its pictures."""
    views: int | None = None
    """Number of training views; by default the split file's, else 3, and 8 for Blender scenes."""
    split: str = "auto"
    """"llff" for every 8th view as test, or the name of a split file within the scene, such as split_near."""
    points: str = "auto"
    """Initial points: a COLMAP folder such as sparse_3views/0, a .ply file, or "random" or "random:COUNT"."""
    downscale: float = 1.0
    """Make pictures smaller by this factor."""
    background: str = "auto"
    """"black" or "white" behind transparent pictures; "auto" is white for Blender scenes, else black."""
    allow_test_points: bool = False
    """Accept initial points that were triangulated from test views; such results are not comparable with others."""

    def absolute(self) -> SceneOptions:
        """Return the options with an absolute path, to be found again from another working directory."""
        return self if self.path == "synthetic" else replace(self, path=str(Path(self.path).resolve()))

    def load(self, *, seed: int = 0) -> Scene:
        """Load the scene; ``seed`` decides random initial points. Errors are those of `load_scene`."""
        return load_scene(
            self.path,
            format=self.format,
            images=self.images,
            views=self.views,
            split=self.split,
            points=self.points,
            downscale=self.downscale,
            background=self.background,
            allow_test_points=self.allow_test_points,
            seed=seed,
        )
