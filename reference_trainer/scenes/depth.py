"""Depth priors of the training photographs: from files (of a network, a sensor, stereo) or from the initial points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reference_trainer.scenes.frames import Frame, check_shape, fitted
from reference_trainer.scenes.images import path_inside
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud, Scene, View

__all__ = ["point_prior", "read_depth", "true_priors", "with_prior"]


def with_prior(view: View, frame: Frame, root: Path, options: SceneOptions) -> View:
    """Return a view with the depth prior of its photograph, the frame on disk, resized and undistorted like it.

    Where some of the map is unknown, a pixel gets the bilinearly weighted mean of the known values, if there is one
    within the pixel or, in a coarser map, where the pixel is.

    Raises:
        FileNotFoundError: if there is no depth file for the photograph.
        ValueError: if the file is no depth map, is constant or unknown everywhere, or its aspect ratio is not the
            photograph's.
    """
    assert options.depth is not None
    folder = root / options.depth.removesuffix(":inverse")
    path = _find(frame, folder)
    prior = read_depth(path)
    camera = frame.camera.resized(view.camera.width, view.camera.height)
    check_shape(path, prior, camera, f"its photograph {frame.path}")
    known = prior.isfinite()
    low, high = (prior[known].min(), prior[known].max()) if bool(known.any()) else (0.0, 0.0)
    layers = torch.stack([((prior - low) / (high - low)).where(known, 0), known.to(prior)])
    mode = "bicubic" if bool(known.all()) else "bilinear"  # some bicubic weights are negative: no mean of a part
    (unit, weight), _ = fitted(layers, camera, frame.distortion if options.undistort else (), mode)
    # A known value has at least a quarter of its share of the pixel that it lies in: just that if at a corner.
    enough = weight > 0.24 * min(1, camera.width * camera.height / prior.numel())
    if low == high or not bool(enough.any()):
        raise ValueError(f"{path} holds no depth: it is constant, or unknown everywhere.")
    resized = (unit / weight * (high - low) + low).where(enough, torch.nan)
    return replace(view, depth_prior=-resized if options.depth.endswith(":inverse") else resized)


def true_priors(scene: Scene, asked: str) -> Scene:
    """Return the built-in scene with depth priors of its training views.

    ``"true"`` asks for the true depth, unknown where nothing is hit; ``"points"`` for that of `point_prior`.

    Raises:
        ValueError: if anything else was asked for.
    """
    if asked == "points":
        return replace(scene, train=tuple(point_prior(view, scene.points) for view in scene.train))
    if asked != "true":
        raise ValueError(
            f'the built-in scene has no folder of depths: depth must be "true" or "points", got {asked!r}.'
        )
    views = []
    for view in scene.train:
        assert view.depth is not None
        views.append(replace(view, depth_prior=view.depth.where(view.depth > 0, torch.nan)))
    return replace(scene, train=tuple(views))


def point_prior(view: View, cloud: PointCloud) -> View:
    """Return a view with a depth prior that needs no file: the depth of the initial points, interpolated.

    Of several points in a pixel the nearest counts. Between them the inverse depth is linear over Delaunay triangles,
    which is exact on a plane; outside their hull the prior is unknown. Occluded points count as well, because a point
    cloud does not tell which those are.

    Raises:
        ValueError: if the points are random, or those that the view sees span no triangle.
        ImportError: if SciPy is missing.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    if cloud.source == "random":
        raise ValueError('depth "points" needs points of the scene, and these are random: name a cloud with --points.')
    camera = view.camera
    pixels, depths = camera.project(cloud.positions.double())
    seen = camera.inside(pixels, depths)
    from_near = depths[seen].argsort()
    places, inverse = pixels[seen][from_near].numpy(), 1 / depths[seen][from_near].numpy()
    first = np.unique(places.astype(int), axis=0, return_index=True)[1]
    try:
        between = LinearNDInterpolator(places[first], inverse[first])(camera.pixel_centers(depths).numpy())
    except (QhullError, ValueError):  # on one line; none
        between = np.full((camera.height, camera.width), np.nan)
    if not np.isfinite(between).any():
        raise ValueError(
            f'depth "points" needs points in every training view, and the {len(first)} pixels of {view.name} that see '
            "one span no triangle: give depth maps with --depth FOLDER, or a denser cloud with --points."
        )
    return replace(view, depth_prior=torch.from_numpy(1 / between).float())


def read_depth(path: Path) -> Tensor:
    """Read a depth map with the values of the file, shape (H, W), float32; nan where they are not finite.

    The file is an ``.npy`` of floats or integers, (H, W) up to axes of length 1, or a gray PNG of 8 or 16 bits;
    ValueError if it is neither.
    """
    from PIL import Image

    try:
        if path.suffix == ".npy":
            # Memory mapping refuses a header that announces more than the file holds before anything is allocated.
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            with Image.open(path, formats=("PNG",)) as file:
                array = np.array(file if file.mode != "P" else file.convert("RGB"))
    except Exception as error:  # each reader raises its own types
        raise ValueError(f"{path} is not a readable .npy file or PNG: {error}") from error
    values = np.squeeze(array)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise ValueError(
            f"{path} must hold one number for each pixel, shape (H, W), got {array.shape} of {array.dtype}: a colored "
            "picture of depth cannot be read back."
        )
    depth = torch.from_numpy(values.astype(np.float32))
    return depth.where(depth.isfinite(), torch.nan)


def _find(frame: Frame, folder: Path) -> Path:
    """Return the depth file of a photograph."""
    names = list(dict.fromkeys((str(Path(frame.name).with_suffix("")), frame.path.stem)))
    for name in names:
        for suffix in (".npy", ".png"):
            if (path := path_inside(folder, name + suffix)).is_file():
                return path
    there = sorted(path.name for path in folder.iterdir())[:5] if folder.is_dir() else "no such folder"
    raise FileNotFoundError(
        f"{folder} has no depth of the photograph {frame.name}: it needs {' or '.join(names)} with .npy or .png; "
        f"there is: {there}."
    )
