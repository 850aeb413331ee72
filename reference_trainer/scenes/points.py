"""Initial points: from COLMAP, a PLY file, or random; and the guard against points triangulated from test views."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.files import is_ply
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.model.ply import load_ply
from reference_trainer.ply_files import PlyVertices, read_ply
from reference_trainer.scenes.colmap import colmap_folders, is_colmap, read_colmap
from reference_trainer.scenes.frames import Frame
from reference_trainer.scenes.images import is_image, path_inside
from reference_trainer.scenes.scene import PointCloud

__all__ = [
    "check_no_leak", "choose_points", "colmap_points", "filled", "model_start", "ply_points", "random_points",
    "random_points_in_frusta",
]  # fmt: skip

RANDOM_POINTS = 10_000  # as DNGaussian for the Blender scenes
INSTANTSPLAT = "points3D.ply"
OPAQUE = 13.0  # replaces an infinite logit, which cannot be trained


def choose_points(
    root: Path,
    points: str,
    train: Sequence[Frame],
    held_out: Iterable[str],
    generator: torch.Generator,
    *,
    own: PointCloud | None = None,
) -> tuple[PointCloud, str]:
    """Return the initial points that the option ``points`` asks for, and a note on the choice.

    It is ``"auto"``, ``"random"``, ``"random:<count>"``, or a ``.ply`` file or COLMAP folder within the scene;
    ``held_out`` names the photographs that do not train; ``own`` are the points that the scene file names. For
    ``"auto"`` and ``"dense"`` these are the largest measured cloud that has seen training views alone, or none: what is
    added to them, such as a dense start (`reference_trainer.scenes.dense`), needs the photographs.

    Raises:
        FileNotFoundError: if the file or folder is missing.
        ValueError: if a file is invalid.
    """
    kind, _, count = points.partition(":")
    if points in ("auto", "dense"):
        offered = [own] if own is not None else []
        offered += [cloud for folder in colmap_folders(root) if (cloud := colmap_points(folder)) is not None]
        names, held_out = [frame.name for frame in train], list(held_out)
        honest = [cloud for cloud in offered if not _seen_outside(cloud, names, held_out)]
        if honest:
            best = max(reversed(honest), key=lambda cloud: len(cloud.positions))
            return best, f"initial points: {len(best.positions):,} from {best.source}"
        empty = PointCloud(torch.empty(0, 3), torch.empty(0, 3), source="none", seen_by=frozenset())
        if not offered:
            return empty, ""
        return empty, (
            f"the points from {', '.join(cloud.source for cloud in offered)} have seen views that do not train (with "
            "--test none and no --views all train; --points FOLDER --allow-test-points takes them anyway)"
        )
    if kind == "random":
        cloud = random_points(train, int(count or RANDOM_POINTS), generator)
        return cloud, f"initial points: {len(cloud.positions):,} random ones"
    path = path_inside(root, points)
    if not is_colmap(path) and not is_ply(path):
        found = sorted(folder.relative_to(root).as_posix() for folder in colmap_folders(root))
        raise FileNotFoundError(f"there is no COLMAP model in {path}; choose auto, random, a .ply or one of {found}.")
    if own is not None and own.source == str(path):
        cloud = own  # in the world of the cameras, which its file need not be, and of known origin
    else:
        cloud = ply_points(path) if is_ply(path) else colmap_points(path)
    if cloud is None:
        raise ValueError(f"{path} has no points to start from; choose another folder or random points.")
    return cloud, f"initial points: {len(cloud.positions):,} from {cloud.source}"


def filled(cloud: PointCloud, train: Sequence[Frame], generator: torch.Generator) -> tuple[PointCloud, str]:
    """Add random points to a cloud of few measured ones, or of none, and return it with a note.

    They lie in the frusta of the training cameras, between the 1st and 99th percentiles of the cloud's depths; without
    any point where `random_points` puts them.
    """
    if len(cloud.positions) == 0:
        return random_points(train, RANDOM_POINTS, generator), f"initial points: {RANDOM_POINTS:,} random ones"
    cameras = [frame.camera for frame in train]
    depths = torch.cat([camera.project(cloud.positions.double())[1] for camera in cameras])
    depths = depths[depths > 0]
    near, far = depths.quantile(torch.tensor([0.01, 0.99], dtype=depths.dtype)).tolist() if len(depths) else (0.0, 0.0)
    if near == far:
        return cloud, ""
    more = random_points_in_frusta(cameras, RANDOM_POINTS, near=near, far=far, generator=generator)
    positions, colors = torch.cat([cloud.positions, more.positions]), torch.cat([cloud.colors, more.colors])
    note = f"{RANDOM_POINTS:,} random ones at their depths are added, because so few points are not enough"
    return replace(cloud, positions=positions, colors=colors), note


def colmap_points(folder: Path) -> PointCloud | None:
    """Read the points of a COLMAP reconstruction, or else InstantSplat's ``points3D.ply``; None if there are none.

    ``seen_by`` names the images in their tracks, or all images of the reconstruction if tracks are missing.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is damaged.
    """
    model = read_colmap(folder)
    if len(model.points.positions):
        positions = torch.from_numpy(model.points.positions).to(torch.float32)
        colors = torch.from_numpy(model.points.colors).to(torch.float32) / 255
        return PointCloud(positions, colors, source=str(folder), seen_by=model.seen_by())
    if (folder / INSTANTSPLAT).is_file():
        return ply_points(folder / INSTANTSPLAT, seen_by=frozenset(image.name for image in model.images))
    return None


def ply_points(path: Path, *, seen_by: frozenset[str] | None = None) -> PointCloud:
    """Read the vertices of a PLY file: a point cloud, or the centers and base colors of a 3DGS model.

    Colors are ``red green blue``, as bytes or as floats up to 1 or 255, else ``f_dc_0`` to ``f_dc_2``, else gray.
    ``seen_by`` names the images that it was made from, if known: a PLY file does not say.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is truncated, not a PLY, has no points, or has invalid positions or colors.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no point cloud {path}.")
    vertices = read_ply(path)
    missing = [axis for axis in "xyz" if axis not in vertices.kinds]
    if missing:
        raise ValueError(
            f"{path} is no point cloud: its vertices lack {', '.join(missing)}; they have {vertices.kinds}."
        )
    positions, colors = vertices.columns("xyz"), _colors(vertices)
    if len(positions) == 0 or not bool(positions.isfinite().all()):
        raise ValueError(f"{path} must hold points with finite positions; it has {len(positions)} points.")
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError(f"{path} must have colors as bytes, or as floats from 0 to 1 or to 255.")
    return PointCloud(positions, colors, source=str(path), seen_by=seen_by)


def _colors(vertices: PlyVertices) -> Tensor:
    """Return the colors (N, 3), in [0, 1] if the file's are valid."""
    rgb, band = ("red", "green", "blue"), ("f_dc_0", "f_dc_1", "f_dc_2")
    if vertices.kinds.keys() >= set(rgb):
        colors = vertices.columns(rgb)
        return colors / 255 if vertices.kinds["red"] == "u1" or bool((colors > 1).any()) else colors
    if vertices.kinds.keys() >= set(band):
        return (0.5 + SH_C0 * vertices.columns(band)).clamp(0, 1)
    return torch.full((len(vertices.rows), 3), 0.5)


def model_start(path: str | Path) -> tuple[Gaussians, PointCloud, str]:
    """Read a 3DGS PLY to start from; return its Gaussians, their centers as points, and a note on it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no 3DGS model, is empty, or was written with test-time opacities.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no model {path} to start from: --init takes a 3DGS .ply.")
    try:
        model = load_ply(path)
    except ValueError as error:
        raise ValueError(f"--init takes a 3DGS .ply; points are for --points: {error}") from error
    start = model.gaussians
    if model.for_rendering or model.opacity_scale != 1 or len(start) == 0:
        fault = "holds opacities of the test, not the plain ones" if len(start) else "holds no Gaussians"
        raise ValueError(f"{path} {fault}: give --init the point_cloud.ply of a training.")
    start = replace(start, opacity_logits=torch.nan_to_num(start.opacity_logits, posinf=OPAQUE, neginf=-OPAQUE))
    cloud = PointCloud(start.means, (0.5 + SH_C0 * start.sh_dc[:, 0]).clamp(0, 1), source=str(path))
    trained = f", trained with {model.regularizer}" if model.regularizer else ""
    return start, cloud, f"starts from the {len(start):,} Gaussians of degree {start.sh_degree} in {path}{trained}"


def check_no_leak(
    points: PointCloud, train_names: Iterable[str], held_out: Iterable[str] = (), *, allow: bool = False
) -> None:
    """Refuse points that were triangulated from images outside the training split, unless allowed.

    Such points leak the geometry of test views into training. A cloud of unknown origin (``seen_by`` is None) passes.
    Formats name one photograph in two ways, COLMAP ``5923.jpg`` and transforms.json ``images/5923``: names that agree
    without extension and leading folders are the same, unless one of ``held_out``, the other images, agrees as well.

    Raises:
        ValueError: if the points have seen other images and ``allow`` is False.

    Example:
        >>> cloud = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3), "sparse/0", frozenset({"a.png", "b.png"}))
        >>> check_no_leak(cloud, ["a.png", "b.png", "c.png"])
        >>> check_no_leak(cloud, ["a.png"])
        Traceback (most recent call last):
        ...
        ValueError: the points from sparse/0 have seen 1 image outside the training split: b.png. ...
    """
    outside = _seen_outside(points, train_names, held_out)
    if outside and not allow:
        shown = ", ".join(outside[:8]) + (", ..." if len(outside) > 8 else "")
        raise ValueError(
            f"the points from {points.source} have seen {len(outside)} image{'s' * (len(outside) > 1)} outside the "
            f"training split: {shown}. Results would not count as sparse-view ones. Take points from the training "
            "views alone or random points, or pass --allow-test-points (allow_test_points=True) to use them anyway."
        )


BLENDER_BOX = 1.3  # half the edge of the box that holds every NeRF-synthetic object, as in the INRIA code


def _seen_outside(points: PointCloud, train: Iterable[str], held_out: Iterable[str]) -> list[str]:
    """Return the names of images that the points have seen and that are none of the training images, sorted."""
    known = set(train)
    ours, others = list(map(_parts, known)), list(map(_parts, held_out))

    def trains(name: str) -> bool:
        tail = _parts(name)
        return any(_agree(tail, each) for each in ours) and not any(_agree(tail, each) for each in others)

    return sorted(name for name in (points.seen_by or frozenset()) - known if not trains(name))


def _parts(name: str) -> tuple[str, ...]:
    """Return the parts of an image's path from its end on, without extension."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if is_image(Path(name)) else path).parts[::-1]


def _agree(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether one of two reversed paths ends the other."""
    return bool(one and other) and all(a == b for a, b in zip(one, other, strict=False))


def random_points(train: Sequence[Frame], count: int, generator: torch.Generator) -> PointCloud:
    """Draw gray points where the training cameras look.

    They fill the NeRF-synthetic box if its center lies in all training pictures, its edge is there a quarter as long as
    these are wide, and all training cameras stand outside it, else the cameras' frusta, between the scene file's depth
    bounds if it has any, else between a quarter and four times the median depth of the point closest to all optical
    axes.

    Raises:
        ValueError: if the optical axes that must give the bounds do not meet in front of the cameras, or the bounds are
            not ``0 < near < far``.
    """
    cameras = [frame.camera for frame in train]
    if all(map(_looks_at_box, cameras)):
        positions = (2 * torch.rand(count, 3, generator=generator) - 1) * BLENDER_BOX
        return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())
    bounds = [frame.bounds for frame in train if frame.bounds is not None]
    if bounds:
        near, far = min(near for near, _ in bounds), max(far for _, far in bounds)
    else:
        focus = _focus_depth(cameras)
        near, far = focus / 4, focus * 4
    return random_points_in_frusta(cameras, count, near=near, far=far, generator=generator)


def _looks_at_box(camera: Camera) -> bool:
    """Whether the camera stands outside the NeRF-synthetic box, has its center in the picture and is not far away."""
    center, depth = camera.project(torch.zeros(3))
    large = 2 * BLENDER_BOX * camera.fx >= 0.25 * camera.width * float(depth)  # not so in a world of millimeters
    return large and float(camera.position.abs().max()) > BLENDER_BOX and bool(camera.inside(center, depth))


def random_points_in_frusta(
    cameras: Sequence[Camera], count: int, *, near: float, far: float, generator: torch.Generator
) -> PointCloud:
    """Draw gray points in the cameras' frusta: uniform over the picture and in inverse depth between two bounds.

    The bounds are in world units. Raises ValueError if they are not ``0 < near < far``.
    """
    if not 0 < near < far:
        raise ValueError(f"the depth bounds must satisfy 0 < near < far, got {near} and {far}.")
    chosen = torch.randint(len(cameras), (count,), generator=generator)
    u, v, share = torch.rand(3, count, generator=generator)
    depth = 1 / (share / near + (1 - share) / far)
    positions = torch.empty(count, 3)
    for number, camera in enumerate(cameras):
        mine = chosen == number
        pixels = torch.stack([u[mine] * camera.width, v[mine] * camera.height], dim=1)
        positions[mine] = camera.lift(pixels, depth[mine])
    return PointCloud(positions, torch.full((count, 3), 0.5), source="random", seen_by=frozenset())


def _focus_depth(cameras: Sequence[Camera]) -> float:
    """Median depth of the point with the least summed squared distance to the optical axes."""
    axes = torch.stack([camera.forward.double() for camera in cameras])
    centers = torch.stack([camera.position.double() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    # The smallest eigenvalue is the summed squared sine of the axes' angles to their common direction.
    if torch.linalg.eigvalsh(normal)[0] > 1e-6 * len(cameras):
        point = torch.linalg.solve(normal, (across @ centers[:, :, None]).sum(0)[:, 0])
        depth = float(((point - centers) * axes).sum(1).median())
        if depth > 0:
            return depth
    raise ValueError(
        "cannot tell how far the scene is: the optical axes of the training cameras do not meet in front of them. "
        "Start from points, not from random ones: --points (points=) takes a COLMAP folder or a .ply file of the scene."
    )
