"""A COLMAP reconstruction as plain data, and COLMAP's camera models."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from reference_trainer.camera import Camera
from reference_trainer.rotations import rotation_matrices

__all__ = [
    "CAMERA_MODELS", "ColmapCamera", "ColmapImage", "ColmapModel", "ColmapPoints", "PointRecords", "add_camera",
    "view_matrix_from_quaternion",
]  # fmt: skip


class CameraModel(NamedTuple):
    """A camera model: its name and its numbers of focal lengths and distortion parameters.

    A fisheye model is no pinhole even where its distortion parameters are 0, so no pinhole approximates it.
    """

    name: str
    focal_lengths: int
    distortion: int
    fisheye: bool = False

    @property
    def parameters(self) -> int:
        """Number of parameters: focal lengths, principal point, distortion."""
        return self.focal_lengths + 2 + self.distortion


# Indexed by model id: COLMAP, src/colmap/sensor/models.h. The distortion of the models that are no fisheyes is
# k1 k2 p1 p2 k3 k4 k5 k6 or a prefix of it.
CAMERA_MODELS = (
    CameraModel("SIMPLE_PINHOLE", 1, 0),
    CameraModel("PINHOLE", 2, 0),
    CameraModel("SIMPLE_RADIAL", 1, 1),
    CameraModel("RADIAL", 1, 2),
    CameraModel("OPENCV", 2, 4),
    CameraModel("OPENCV_FISHEYE", 2, 4, fisheye=True),
    CameraModel("FULL_OPENCV", 2, 8),
    CameraModel("FOV", 2, 1, fisheye=True),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 1, 1, fisheye=True),
    CameraModel("RADIAL_FISHEYE", 1, 2, fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 2, 8, fisheye=True),
)
_MODELS: dict[int | str, CameraModel] = {k: m for n, m in enumerate(CAMERA_MODELS) for k in (n, m.name)}


class ColmapCamera(NamedTuple):
    """Intrinsics of one camera: its pinhole part, posed at the world origin, float64, and its distortion.

    Convention: half-pixel centers, as in the rest of the program; the distortion is in COLMAP's order, empty for the
    pinhole models.
    """

    model: CameraModel
    pinhole: Camera
    distortion: tuple[float, ...]

    def at(self, world_to_camera: NDArray[np.float64]) -> Camera:
        """Return the pinhole part at a pose (4, 4).

        Raises:
            ValueError: if the model is a fisheye.
        """
        if self.model.fisheye:
            raise ValueError(
                f"a camera is {self.model.name}, which no pinhole camera approximates. Undistort the images first "
                "(colmap image_undistorter)."
            )
        return replace(self.pinhole, world_to_camera=torch.from_numpy(world_to_camera))


def add_camera(
    cameras: dict[int, ColmapCamera],
    number: int,
    model: int | str,
    width: int,
    height: int,
    parameters: tuple[float, ...],
) -> None:
    """Add a camera under its number; the model is a number or a name, the parameters are in COLMAP's order.

    Raises:
        ValueError: if the number is taken, the model is unknown, or the size or a parameter is invalid.
    """
    if number in cameras:
        raise ValueError(f"it has camera {number} twice.")
    if model not in _MODELS:
        raise ValueError(f"camera {number} has the unknown camera model {model}.")
    known = _MODELS[model]
    if len(parameters) != known.parameters or not np.isfinite(parameters).all():
        raise ValueError(f"camera {number}: {known.name} needs {known.parameters} finite parameters, got {parameters}.")
    *focal, cx, cy = parameters[: known.focal_lengths + 2]
    try:
        pinhole = Camera(torch.eye(4, dtype=torch.float64), focal[0], focal[-1], cx, cy, width, height)
    except ValueError as error:
        raise ValueError(f"camera {number}: {error}") from error
    cameras[number] = ColmapCamera(known, pinhole, parameters[known.focal_lengths + 2 :])


def view_matrix_from_quaternion(qvec: Sequence[float], tvec: Sequence[float]) -> NDArray[np.float64]:
    """Build the view matrix (4, 4) from COLMAP's quaternion, wxyz, and translation.

    Raises:
        ValueError: if they are not finite, or the quaternion is zero.
    """
    with np.errstate(over="ignore"):  # overflow gives inf, which is refused
        norm = np.linalg.norm(qvec)
    if not (np.isfinite(tvec).all() and 0 < norm < np.inf):
        raise ValueError(f"the pose must be a finite non-zero quaternion and translation, got {qvec} and {tvec}.")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(torch.from_numpy(np.array([qvec]) / norm))[0].numpy()
    matrix[:3, 3] = tvec
    return matrix


@dataclass(frozen=True)
class ColmapImage:
    """One registered image: its number, path within the image folder, camera number and pose (4, 4), float64.

    Its 2D features lie at ``keypoints`` (K, 2), pixels, float64, and observe the 3D points numbered ``point_ids``
    (K,), -1 for none. Raises ValueError if a feature has no finite position.
    """

    id: int
    name: str
    camera_id: int
    world_to_camera: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    point_ids: NDArray[np.int64]

    def __post_init__(self) -> None:
        if not np.isfinite(self.keypoints).all():
            raise ValueError(f"image {self.id} ({self.name!r}) has features without a finite position.")


@dataclass(frozen=True)
class ColmapPoints:
    """The M triangulated points: numbers (M,), world coordinates (M, 3), float64, and RGB (M, 3), uint8.

    ``tracks`` holds, for each point, an int64 array of the numbers of the images that observe it; the array is empty
    if the reconstruction does not say. Raises ValueError if a position is not finite.
    """

    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    tracks: tuple[NDArray[np.int64], ...]

    def __post_init__(self) -> None:
        bad = self.ids[~np.isfinite(self.positions).all(axis=1)]
        if len(bad):
            raise ValueError(f"{len(bad)} of {len(self.ids)} points have no finite position, such as point {bad[0]}.")


class PointRecords:
    """Accumulates the points of a file in compact arrays: as Python objects they would take ten times the memory."""

    def __init__(self) -> None:
        self._ids, self._positions, self._colors = array("q"), array("d"), array("B")
        self._images, self._ends = array("q"), array("q")

    def add(self, number: int, position: Sequence[float], color: Sequence[int], images: NDArray[np.integer]) -> None:
        """Add a point and the numbers of the images in its track.

        Raises:
            ValueError: if there are not three coordinates and three colors.
            OverflowError: if a number does not fit 64 bits, or a color a byte.
        """
        if len(position) != 3 or len(color) != 3:
            raise ValueError(f"a point has three coordinates and three colors, got {[*position]} and {[*color]}.")
        self._ids.append(number)
        self._positions.extend(position)
        self._colors.extend(color)
        self._images.frombytes(images.astype(np.int64).tobytes())
        self._ends.append(len(self._images))

    def finish(self) -> ColmapPoints:
        """Return the points. Raises ValueError if a position is not finite."""
        images = np.asarray(self._images, np.int64)
        return ColmapPoints(
            np.asarray(self._ids, np.int64),
            np.asarray(self._positions, np.float64).reshape(-1, 3),
            np.asarray(self._colors, np.uint8).reshape(-1, 3),
            tuple(images[start:end] for start, end in zip([0, *self._ends], self._ends, strict=False)),
        )


@dataclass(frozen=True)
class ColmapModel:
    """A reconstruction: cameras by number, images sorted by name, and points, possibly none.

    Raises ValueError if an image refers to a missing camera, or two images share a name or number.
    """

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    points: ColmapPoints

    def __post_init__(self) -> None:
        for image in self.images:
            if image.camera_id not in self.cameras:
                raise ValueError(
                    f"image {image.name!r} has camera {image.camera_id}; there are {sorted(self.cameras)}."
                )
        if len({image.name for image in self.images}) != len(self.images):
            raise ValueError("two images have the same name.")
        if len({image.id for image in self.images}) != len(self.images):
            raise ValueError("two images have the same number.")

    def seen_by(self) -> frozenset[str]:
        """Return the names of the images that the points come from: those in their tracks.

        A point without a track may come from any image, so one such point makes it all images of the reconstruction.
        """
        if any(len(track) == 0 for track in self.points.tracks):
            return frozenset(image.name for image in self.images)
        used = set(np.concatenate(self.points.tracks).tolist()) if self.points.tracks else set()
        names = {image.id: image.name for image in self.images}
        return frozenset(names.get(i, f"<image {i}>") for i in used)
