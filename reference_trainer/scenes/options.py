"""The options that decide scenes and cameras: what the command line offers and what workers receive."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

__all__ = ["BACKGROUNDS", "OrbitOptions", "SceneOptions", "World", "check_scene"]

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}

World = Literal["y-down", "y-up", "z-up", "z-down", "x-up", "x-down"]
"""Which axis of the world is vertical, and which way it points."""


@dataclass(frozen=True)
class SceneOptions:
    """Which photographs, cameras and points to use.

    Raises:
        ValueError: if an option is out of range, whatever the scene holds.

    Example:
        >>> SceneOptions("fern", images="images_8", views=3).absolute().views
        3
    """

    path: str = "synthetic"
    """Scene folder (COLMAP, VGGT, InstantSplat, nerfstudio, instant-ngp, Blender, LLFF or IDR/NeuS files, or an
    .npz of poses), or "synthetic" for the built-in scene."""
    format: str = "auto"
    """"blender", "transforms", "colmap", "llff", "idr", "npz", a reader of yours as my_module:my_function, or "auto"
    for the first whose files are there."""
    images: str | None = None
    """Image folder within the scene, such as images_8; the cameras are scaled to its pictures. By default "images", or
    the largest images_<factor> of at most half a megapixel."""
    views: int | None = None
    """Number of training views; by default the split file's; else all if nothing is held out, 8 for Blender scenes,
    and 3."""
    split: str = "auto"
    """"llff" for every 8th view as test, "dtu" for that protocol, or the name of a JSON file within the scene, such as
    split_near; by default split.json, else nerfstudio's lists, else the format's rule, or no test views below 8
    photographs."""
    test: Literal["auto", "none"] = "auto"
    """"none" to hold nothing out: all photographs train, or --views of them."""
    points: str = "auto"
    """Initial points: a COLMAP folder such as sparse_3views/0, a .ply file (points or 3DGS) within the scene, "random"
    or "random:COUNT", or "dense" for points measured on the training photographs by stereo, in half a minute; by
    default the largest cloud made from training views alone. If it has fewer than 10,000 points, or there is none, up
    to ten training photographs get a dense start besides; where that fails, a cloud of fewer than 1,000 random points.
    """
    init: str | None = None
    """A 3DGS .ply, anywhere: training starts from all parameters of its Gaussians, in place of points."""
    depth: str | None = None
    """Depth of the training photographs, for terms of the loss that need one: a folder of the scene with .npy or gray
    .png files named like them, of any scale and shift; FOLDER:inverse if it is larger where nearer, as MiDaS's is;
    "points" for the depth of the initial points, interpolated; "true" for the built-in scene's own."""
    downscale: float | None = None
    """Make pictures smaller by this factor; by default those above half a megapixel are reduced to that."""
    background: str = "auto"
    """"black" or "white" behind transparent pictures; "auto" is white for Blender scenes, else black."""
    one_exposure: bool = False
    """Make photographs of different exposure or white balance equally bright, by the points that they share; nothing
    where they do not differ. Test views are compared at the exposure that the training cameras suggest."""
    undistort: bool = True
    """Undo lens distortion; published sparse-view protocols, such as LLFF's, leave it in."""
    allow_test_points: bool = False
    """Accept initial points that were triangulated from test views; such results are not comparable with others."""

    def __post_init__(self) -> None:
        if self.downscale is not None and not 1 <= self.downscale < math.inf:
            raise ValueError(f"downscale must be a finite number of at least 1, got {self.downscale}.")
        if self.background not in ("auto", *BACKGROUNDS):
            raise ValueError(f"background must be auto, {' or '.join(BACKGROUNDS)}, got {self.background!r}.")
        if self.views is not None and self.views < 1:
            raise ValueError(f"views must be at least 1, got {self.views}.")
        if self.test not in ("auto", "none"):
            raise ValueError(f"test must be auto or none, got {self.test!r}.")
        kind, colon, count = self.points.partition(":")
        if not self.points or (kind == "random" and colon and not (count.isdecimal() and int(count) > 0)):
            raise ValueError(
                "points must be auto, dense, random, random:<count> such as random:10000, or a .ply or COLMAP folder "
                f"of the scene, got {self.points!r}."
            )
        if self.init is not None and self.points != "auto":
            raise ValueError(f"init takes the place of points: leave out one of {self.init} and {self.points}.")

    def absolute(self) -> SceneOptions:
        """Return the options with absolute paths, valid in any working directory."""
        path = self.path if self.path == "synthetic" else str(Path(self.path).resolve())
        return replace(self, path=path, init=None if self.init is None else str(Path(self.init).resolve()))


def check_scene(path: str | Path) -> None:
    """Refuse a scene folder that is not there, with a FileNotFoundError."""
    if path != "synthetic" and not Path(path).is_dir():
        raise FileNotFoundError(f"there is no scene folder {path}; for the built-in scene, say 'synthetic'.")


@dataclass(frozen=True)
class OrbitOptions:
    """Cameras around a model that comes without a scene.

    Raises:
        ValueError: if there is no camera or no pixel, or the arc is not in (0, 360] degrees.

    Example:
        >>> OrbitOptions(cameras=2, world="z-up").arc
        360.0
    """

    cameras: int = 8
    """Without a scene: number of cameras on the orbit."""
    size: int = 384
    """Without a scene: width and height of the pictures, pixels."""
    world: World = "y-down"
    """Without a scene: the vertical axis. COLMAP worlds are mostly y-down, Blender and nerfstudio z-up."""
    arc: float = 360.0
    """Without a scene: degrees of the circle that the cameras cover; in a y-down world +z is the middle of it."""

    def __post_init__(self) -> None:
        if self.cameras < 1 or self.size < 1 or not 0 < self.arc <= 360:
            raise ValueError(
                f"an orbit needs at least 1 camera and a size of at least 1 pixel, and an arc in (0, 360] degrees, got "
                f"cameras={self.cameras}, size={self.size} and arc={self.arc:g}."
            )
