"""Which initial points a scene folder offers, and the choice among them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import path_inside
from reference_trainer.scenes.ply_points import ply_points
from reference_trainer.scenes.points import colmap_points, random_points_in_box, random_points_in_frusta
from reference_trainer.scenes.scene import PointCloud

__all__ = ["choose_points"]

RANDOM_POINTS = 10_000  # as DNGaussian for the Blender scenes
BLENDER_BOX = 1.3  # half the edge of the box that holds every NeRF-synthetic object, as in the INRIA code


def choose_points(root: Path, points: str, train: Sequence[Frame], generator: torch.Generator) -> PointCloud:
    """Return the initial points that an option of ``load_scene`` asks for.

    Random points fill the NeRF-synthetic box if its centre lies in all training pictures and all training cameras stand
    outside it, else the training cameras' frusta, between the scene file's depth bounds where it has them.

    Args:
        root: the scene folder.
        points: ``"auto"``, ``"random"``, ``"random:<count>"``, a ``.ply`` file or a COLMAP folder within the scene.
        train: the training frames.
        generator: source of randomness.

    Raises:
        FileNotFoundError: if the file or folder is missing.
        ValueError: if the option or a file makes no sense.
    """
    if points == "auto":
        points = _honest_folder(root, {frame.name for frame in train}) or "random"
    kind, _, count = points.partition(":")
    if kind == "random":
        if count and not (count.isdecimal() and int(count) > 0):
            raise ValueError(f"points must be random or random:<count>, such as random:10000, got {points!r}.")
        return _random_points(train, int(count or RANDOM_POINTS), generator)
    path = path_inside(root, points)
    if path.suffix == ".ply":
        return ply_points(path)
    if not path.is_dir():
        found = sorted(p.parent.relative_to(root).as_posix() for p in root.glob("sparse*/*/points3D.*"))
        raise FileNotFoundError(
            f"there is no folder {path} to take points from; choose auto, random or one of {sorted(set(found))}."
        )
    return colmap_points(path)


def _honest_folder(root: Path, train_names: set[str]) -> str | None:
    """Of the folders ``sparse_*/0`` made from training views alone, name the one with most points."""
    best, most = None, 0
    for folder in sorted(root.glob("sparse_*/0")):
        model = read_colmap(folder)
        if len(model.points.ids) > most and model.seen_by() <= train_names:
            best, most = folder.relative_to(root).as_posix(), len(model.points.ids)
    return best


def _random_points(train: Sequence[Frame], count: int, generator: torch.Generator) -> PointCloud:
    """Draw points where the cameras look."""
    cameras = [frame.camera for frame in train]
    if all(_looks_at_box(frame) for frame in train):
        return random_points_in_box(count, BLENDER_BOX, generator=generator)
    bounds = [frame.bounds for frame in train if frame.bounds is not None]
    if bounds:
        near, far = min(near for near, _ in bounds), max(far for _, far in bounds)
        return random_points_in_frusta(cameras, count, near=near, far=far, generator=generator)
    return random_points_in_frusta(cameras, count, generator=generator)


def _looks_at_box(frame: Frame) -> bool:
    """Whether the camera stands outside the NeRF-synthetic box and has its centre, the origin, in the picture."""
    camera = frame.camera
    x, y, z = camera.world_to_camera[:3, 3].tolist()
    if float(camera.position.abs().max()) <= BLENDER_BOX or z <= 0:
        return False
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool(0 <= u <= camera.width and 0 <= v <= camera.height)
