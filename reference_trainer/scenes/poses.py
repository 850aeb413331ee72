"""Cameras and points for photographs that have none, by COLMAP's structure from motion (pycolmap)."""

from __future__ import annotations

import filecmp
import os
import shutil
import sqlite3
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from reference_trainer.progress import progress_bar
from reference_trainer.scenes._colmap_model import CAMERA_MODELS
from reference_trainer.scenes.colmap import colmap_folders
from reference_trainer.scenes.images import (
    decode_image,
    image_size,
    list_images,
    photograph_folder,
    unreadable_photographs,
)

__all__ = ["FEW", "FoundPoses", "adjust", "enlarge", "feature_size", "find_poses", "left_out", "reconstruct"]

FEW = 8
"""Below this many photographs COLMAP's settings, made for dozens, are replaced."""
LARGEST_SIDE = 1600
"""Pixels of the longer side at which features are extracted: beyond, time grows and poses hardly improve."""
ENLARGED = 2
"""Fewer than `FEW` photographs that are smaller are enlarged so many times at most: several times as many features."""
CERTAIN = 0.5
"""Pixels of error beyond which a feature counts less and less in the last bundle adjustment."""
_LEFT_OUT = "left_out.txt"  # beside the files of the model


@dataclass(frozen=True)
class FoundPoses:
    """The outcome of `find_poses`."""

    folder: Path  # of the COLMAP model, ``sparse/0`` in the scene
    registered: tuple[str, ...]  # names of the photographs that now have a camera
    left_out: tuple[str, ...]  # names of the others
    unread: Mapping[str, str]  # why the photographs were not read that were not, by name
    points: int  # number of points
    error: float  # mean reprojection error of their features, pixels of the photographs
    focal: tuple[float, ...]  # focal lengths of the cameras, pixels, sorted

    @property
    def about_others(self) -> list[str]:
        """What to do about the photographs without a camera, a line each; empty if all have one."""
        lines = []
        if self.left_out:
            lines.append(
                f"left out: {', '.join(self.left_out)}. They share too little with the others: add a photograph from "
                "in between, or go on without them"
            )
        return lines + [f"not read, and left out: {why}" for why in self.unread.values()]

    def __str__(self) -> str:
        """Describe what was found, and what to do about photographs left out."""
        lengths = " to ".join(f"{x:.0f}" for x in dict.fromkeys((self.focal[0], self.focal[-1])))
        every = len(self.registered) + len(self.left_out) + len(self.unread)
        lines = [
            f"{len(self.registered)} of {every} photographs registered: {', '.join(self.registered)}",
            f"{self.points:,} points, reprojection error {self.error:.2f} pixels, focal length {lengths} pixels",
        ]
        return "\n".join(lines + self.about_others)


def feature_size(width: int, height: int, *, few: bool) -> tuple[int, int]:
    """Return the size at which features of a photograph are extracted, pixels: one of fewer than `FEW`, or of more."""
    by = min(LARGEST_SIDE / max(width, height), ENLARGED if few else 1)
    return round(by * width), round(by * height)


def find_poses(
    scene: str | Path,
    out: str | Path | None = None,
    *,
    camera: str | None = None,
    seed: int = 0,
    progress: bool = False,
) -> FoundPoses:
    """Find cameras and points for a folder of photographs, and write them as the COLMAP model ``sparse/0``.

    The photographs are those in ``images`` of the scene folder, or in the folder itself. Those of equal size and focal
    length are taken to share one camera. Those that are damaged or unknown to COLMAP are left out, and named. Below
    `FEW` photographs, where COLMAP's own settings find little, features use domain-size pooling and affine shapes,
    points need two photographs instead of three, small photographs are enlarged, and the focal lengths are kept if EXIF
    data give them for all photographs, since so few determine them less well. A last bundle adjustment has a robust
    loss. The model is written atomically, and the result is deterministic.

    Args:
        scene: the scene folder.
        out: another scene folder to write to, with copies of the photographs in ``images``; by default ``scene``.
        camera: COLMAP's name of a camera model; by default SIMPLE_PINHOLE below `FEW` photographs, else SIMPLE_RADIAL.
        seed: of all randomness.
        progress: whether to show progress bars.

    Raises:
        ImportError: if pycolmap is missing.
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds fewer than two photographs that can be read, they show too little in common for any
            camera, or there is no such camera model or seed.
        FileExistsError: if the scene has cameras already, or another photograph of a name.
        OSError: if it cannot be written.
    """
    known = [model.name for model in CAMERA_MODELS]
    if camera is not None and camera not in known:
        raise ValueError(f"there is no camera model {camera!r}; choose one of {', '.join(known)}.")
    if not 0 <= seed < 2**32:
        raise ValueError(f"COLMAP's seed must be in [0, 2^32), got {seed}.")
    scene = Path(scene)
    out = scene if out is None else Path(out)
    folder = photograph_folder(scene)
    photos, unread = _sorted(folder)
    _check_number(photos, unread, folder)
    if found := colmap_folders(out):
        raise FileExistsError(f"{out} has cameras already, in {found[0]}: train on it, or delete them to find others.")
    images, place = out / "images", out / "sparse" / "0"
    if place.exists() and any(place.iterdir()):
        raise FileExistsError(f"{place} holds files, but no cameras: delete them, or give another --out.")
    there = out.resolve() == scene.resolve() or images.resolve() == folder.resolve()
    copies = {} if there else {photo: images / photo.name for photo in photos}
    for photo, copy in copies.items():
        if copy.exists() and not filecmp.cmp(photo, copy):
            raise FileExistsError(f"{images} holds another {photo.name}, which is not overwritten: give another --out.")
    with tempfile.TemporaryDirectory() as work:
        model = reconstruct(photos, unread, Path(work), camera, seed, progress)
        if model is None:
            raise ValueError(
                f"none of the {len(photos)} photographs in {folder} could be placed: neighboring ones must show "
                "the same things from places some steps apart, sharp, without much that moves. Add photographs "
                "from in between, or take the poses of VGGT or InstantSplat."
            )
        registered = {image.name for image in model.images.values() if image.has_pose}
        for photo, copy in copies.items():
            if photo.name not in unread:
                images.mkdir(parents=True, exist_ok=True)
                shutil.copy2(photo, copy)
        result = FoundPoses(
            place,
            tuple(photo.name for photo in photos if photo.name in registered),
            tuple(photo.name for photo in photos if photo.name not in {*registered, *unread}),
            unread,
            model.num_points3D(),
            model.compute_mean_reprojection_error(),
            tuple(sorted(camera.mean_focal_length() for camera in model.cameras.values())),
        )
        _write(model, place, result.about_others)
    return result


def left_out(scene: Path) -> list[str]:
    """Return what `find_poses` has said about photographs of a scene without a camera, a line each."""
    path = scene / "sparse" / "0" / _LEFT_OUT
    return path.read_text("utf-8", errors="replace").splitlines() if path.is_file() else []


def _sorted(folder: Path) -> tuple[list[Path], dict[str, str]]:
    """Return the photographs of a folder that can be read, and by name what is wrong with the others."""
    photos = list_images(folder)
    unread = {name: f"{name}: save it as JPEG or PNG" for name in unreadable_photographs(folder)}
    for photo in photos:
        try:
            decode_image(photo)  # COLMAP takes what is left of a truncated one
        except ValueError as error:
            unread[photo.name] = str(error)
    return [photo for photo in photos if photo.name not in unread], unread


def _check_number(photos: list[Path], unread: Mapping[str, str], folder: Path) -> None:
    """Refuse fewer than two photographs with a ValueError."""
    if len(photos) < 2:
        held = f"{len(photos) or 'no'} photograph{'' if len(photos) == 1 else 's'}{' that can be read' * bool(unread)}"
        others = f" Not read: {'; '.join(unread.values())}." * bool(unread)
        raise ValueError(f"{folder} holds {held}, and depth needs at least 2: take another one.{others}")


def reconstruct(
    photos: list[Path], unread: dict[str, str], work: Path, camera: str | None, seed: int, progress: bool
) -> Any:
    """Return the reconstruction that registers the most photographs, None if there is none.

    What COLMAP cannot read is left out and added to ``unread``.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError("finding cameras needs pycolmap: pip install 'ca_reg[colmap]'.") from error
    folder, database, larger = photos[0].parent, work / "database.db", work / "photographs"
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    taken_with = {}
    for photo in photos:
        try:
            taken_with[photo] = pycolmap.infer_camera_from_image(photo)
        except (RuntimeError, ValueError):
            unread[photo.name] = f"COLMAP cannot read {photo}, WebP for one: save it as JPEG or PNG"
    _check_number(photos := list(taken_with), unread, folder)
    few, alike = len(photos) < FEW, defaultdict(list)
    known = all(taken.has_prior_focal_length for taken in taken_with.values())
    for photo, taken in taken_with.items():
        alike[(*image_size(photo), taken.mean_focal_length())].append(photo.name)
    reader = pycolmap.ImageReaderOptions(camera_model=camera or ("SIMPLE_PINHOLE" if few else "SIMPLE_RADIAL"))
    features = pycolmap.FeatureExtractionOptions(max_image_size=LARGEST_SIDE)
    features.sift.estimate_affine_shape = features.sift.domain_size_pooling = few
    pycolmap.Database.open(database).close()
    for names in alike.values():  # in a fixed order: image numbers are part of the result
        pycolmap.import_images(
            database, folder, camera_mode=pycolmap.CameraMode.SINGLE, image_names=names, options=reader
        )
    sizes = enlarge(photos, database, larger) if few else {}
    folder = larger if sizes else folder

    extract = partial(
        pycolmap.extract_features, database, folder, image_names=[photo.name for photo in photos],
        extraction_options=features,
    )  # fmt: skip
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    match = partial(
        pycolmap.match_exhaustive, database, pairing_options=pycolmap.ExhaustivePairingOptions(block_size=5),
        verification_options=verification,
        # One thread: with more, pairs enter the database in the order in which they end, which mapping follows.
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=1),
    )  # fmt: skip
    pairs = len(photos) * (len(photos) - 1) // 2
    _with_progress(extract, database, "keypoints", len(photos), desc="features", unit="photo", disable=not progress)
    _with_progress(match, database, "two_view_geometries", pairs, desc="matching", unit="pair", disable=not progress)
    # One thread: with more, the order of summation, and so the result, would depend on their number.
    mapping = pycolmap.IncrementalPipelineOptions(min_model_size=2, num_threads=1, random_seed=seed)
    if few:
        mapping.triangulation.ignore_two_view_tracks = False
        mapping.mapper.init_min_tri_angle, mapping.mapper.init_min_num_inliers = 4.0, 30
        mapping.mapper.abs_pose_min_num_inliers = 15
        mapping.ba_refine_focal_length = mapping.mapper.abs_pose_refine_focal_length = not known
    models = pycolmap.incremental_mapping(database, folder, work, options=mapping).values()
    if not models:
        return None
    model = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    adjust(model, mapping.ba_refine_focal_length)
    _reduce(model, sizes)
    return model


def enlarge(photos: list[Path], database: Path, folder: Path) -> dict[int, tuple[int, int]]:
    """Write what features are extracted from if some photographs are small: enlarged copies, and copies of the others.

    Return the sizes that the cameras of enlarged photographs had in the database, by number.
    """
    import pycolmap
    from PIL.Image import Resampling

    sizes = {}
    with closing(pycolmap.Database.open(database)) as opened:
        for camera in opened.read_all_cameras():
            size = camera.width, camera.height
            larger = feature_size(*size, few=True)
            if larger > size:
                sizes[camera.camera_id] = size
                camera.rescale(*larger)
                opened.update_camera(camera)
        taken_with = {image.name: opened.read_camera(image.camera_id) for image in opened.read_all_images()}
        for photo in photos if sizes else ():
            folder.mkdir(exist_ok=True)
            camera = taken_with[photo.name]
            if camera.camera_id in sizes:
                resized = decode_image(photo).convert("RGB")
                resized = resized.resize((camera.width, camera.height), Resampling.LANCZOS)
                resized.save(folder / photo.name, quality=100, subsampling=0)
            else:
                shutil.copy(photo, folder)
    return sizes


def adjust(model: Any, refine_focal_length: bool) -> None:
    """Adjust cameras and points once more, with a robust loss: COLMAP's own squares the errors of all features."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(refine_focal_length=refine_focal_length, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = CERTAIN
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _reduce(model: Any, sizes: Mapping[int, tuple[int, int]]) -> None:
    """Give enlarged cameras, and the features of their photographs, their sizes back."""
    for image in model.images.values():
        if image.camera_id in sizes:
            camera, size = model.cameras[image.camera_id], sizes[image.camera_id]
            for feature in image.points2D:
                feature.xy *= np.array(size) / (camera.width, camera.height)
    for number in {*sizes} & {*model.cameras}:
        model.cameras[number].rescale(*sizes[number])
    model.update_point_3d_errors()


def _with_progress(job: Callable[..., None], database: Path, table: str, total: int, **bar: Any) -> None:
    """Run a COLMAP job in another thread, with a progress bar over the rows it has written; Ctrl-C cancels it."""
    import pycolmap

    stop, rows = pycolmap.CancellationToken(), f"SELECT count(*) FROM {table}"
    shown = progress_bar(total=total, **bar)
    with ThreadPoolExecutor(1) as pool, closing(sqlite3.connect(database)) as opened, shown:
        running = pool.submit(job, cancellation_token=stop)
        try:
            done: set[Any] = set()
            while not done:
                done = wait([running], 0.5).done
                shown.update(opened.execute(rows).fetchone()[0] - shown.n)
        finally:
            stop.cancel()
        running.result()


def _write(model: Any, folder: Path, about: Sequence[str]) -> None:
    """Write a model, and lines about what it leaves out, atomically: beside its place, then moved there."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)  # left by a process that was killed
    part.mkdir(parents=True)
    try:
        model.write_binary(part)
        if about:
            (part / _LEFT_OUT).write_text("\n".join(about), "utf-8", errors="backslashreplace")
        os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
