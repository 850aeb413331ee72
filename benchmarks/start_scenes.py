"""Scenes whose trainings start from other points, or with cameras of the training photographs alone.

    python -m benchmarks.start_scenes points ../shared/data OUT SCENE...     # OUT/SCENE with a .ply for each start
    python -m benchmarks.start_scenes counts ../shared/data OUT SCENE...     # the same of dense starts of other numbers
    python -m benchmarks.start_scenes finer ../shared/data OUT SCENE...      # measured on photographs as they are kept
    python -m benchmarks.start_scenes cameras ../shared/data OUT SCENE...    # OUT/SCENE-own
    python -m benchmarks.start_scenes many ../shared/data OUT SCENE...       # OUT/SCENE-many, 14 or 16 photographs

What comes of them is in benchmarks/dense_start.md and choices.md.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.paper.scenes import SCENES
from reference_trainer.scenes.dense import dense_points, dense_start
from reference_trainer.scenes.load import evenly_spaced, load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.points import colmap_points, filled, random_points_in_frusta
from reference_trainer.scenes.poses import LARGEST_SIDE, enlarge, find_poses
from reference_trainer.scenes.scene import PointCloud

__all__ = [
    "COUNTS", "FEW_AND_RANDOM", "MANY", "SIFT", "STARTS", "from_dense", "from_today", "with_counts",
    "with_finer_points", "with_many_photographs", "with_own_cameras", "with_points",
]  # fmt: skip

SIFT = {
    "fern": "sparse_3views/0", "herz-jesu": "sparse_3near/0", "fountain": "sparse_3near/0",
    "sceaux": "sparse_3views/0", "cape": "sparse_3views/0",
}  # fmt: skip
"""Points that COLMAP found in the training photographs; the other scenes are taken to have none."""
OTHER = ("fern", "sceaux", "cape", "dtu-scan65", "dtu-scan24")
"""Scenes whose declared points are the dense cloud of another program, of 8,000 to 15,000 points."""
MANY = {"fern": 14, "cape": 16, "dtu-scan65": 16, "dtu-scan24": 16}
"""Scenes of more than ten photographs, and how many of them train."""
FEW = 450
"""So many it finds where it must find the cameras as well."""
COUNTS = (5_000, 8_000, 30_000)
"""Points of a dense start, which usually has 15,000."""
MIN_MATCHES = 20
"""So many points place a photograph."""
FEW_AND_RANDOM = "few measured points, random added"
STARTS = {
    "random": "random points", "few_and_random.ply": FEW_AND_RANDOM, "dense.ply": "dense",
    "dense_and_few.ply": "dense and few", "dense_and_random.ply": "dense, few and random", "sift.ply": "SIFT",
    "dense_and_sift.ply": "dense and SIFT", "dense_and_other.ply": "dense and other",
    "measured.ply": "measured", "dense_and_measured.ply": "dense and measured",
    "dense_5000.ply": "5,000 dense and few", "dense_8000.ply": "8,000 dense and few",
    "dense_30000.ply": "30,000 dense and few", "dense_filled.ply": "filled",
    "finer.ply": "finer", "farther.ply": "farther", "now.ply": "as now",
}  # fmt: skip
"""Values of ``--points`` whose rows stand apart, and what they are called: files that are made here, or copies that
keep what a later program made of the same name."""


def from_dense(scene: str) -> str:
    """Return the name of a scene that begins with a dense start, and with few measured points where there are any."""
    return f"{scene}, {'dense and few' if scene in SIFT else 'dense'}"


def from_today(scene: str) -> str:
    """Return the name of a scene that begins with the dense start as it is now, which of lego has not changed."""
    return from_dense(scene) if scene == "lego" else f"{scene}, as now"


def with_points(data: Path, out: Path, name: str) -> None:
    """Write the folder of a scene with links to its files, and a point cloud for every start."""
    folder = _linked(data / name, out / name)
    sift = colmap_points(data / name / SIFT[name]) if name in SIFT else None
    train = load_scene(replace(SCENES[name].options, path=str(data / name)), trains=False).train
    generator = torch.Generator().manual_seed(0)
    few = _few(sift, generator)
    both, _ = dense_start(train, few)
    number = len(both.positions) - len(few.positions)
    clouds = {"dense": replace(both, positions=both.positions[:number], colors=both.colors[:number])}
    if name in OTHER:
        other = load_scene(replace(SCENES[name].options, path=str(data / name)), trains=False).points
        clouds["dense_and_other"] = dense_start(train, other)[0]
    if sift is not None:
        clouds |= {"few_and_random": filled(few, train, generator)[0], "dense_and_few": both}
        clouds |= {"sift": sift, "dense_and_sift": dense_start(train, sift)[0]}
    cameras = [view.camera for view in train]
    depths = torch.cat([camera.project(both.positions)[1] for camera in cameras])
    near, far = depths[depths > 0].quantile(torch.tensor([0.01, 0.99])).tolist()
    apart = torch.Generator().manual_seed(1)
    random = random_points_in_frusta(cameras, 5_000, near=near, far=far, generator=apart)
    more = [torch.cat(pair) for pair in ((both.positions, random.positions), (both.colors, random.colors))]
    clouds["dense_and_random"] = replace(both, positions=more[0], colors=more[1])
    for start, cloud in clouds.items():
        write_points(folder / f"{start}.ply", cloud.positions, cloud.colors)
        print(f"{name}: {start}, {len(cloud.positions):,} points")


def with_counts(data: Path, out: Path, name: str) -> None:
    """Write the folder of a scene with links to its files, and dense starts of `COUNTS` points beside the few."""
    folder = _linked(data / name, out / name)
    train = load_scene(replace(SCENES[name].options, path=str(data / name)), trains=False).train
    few = _few(colmap_points(data / name / SIFT[name]) if name in SIFT else None, torch.Generator().manual_seed(0))
    for count in COUNTS:
        cloud = dense_points(train, few, count=count)
        positions, colors = torch.cat([cloud.positions, few.positions]), torch.cat([cloud.colors, few.colors])
        write_points(folder / f"dense_{count}.ply", positions, colors)
        print(f"{name}: {len(positions):,} points")


def with_finer_points(data: Path, out: Path, name: str) -> None:
    """Write the folder of a scene with links to its files, and a dense start of photographs that are finer.

    Those that train are made smaller; the start is measured on them as they are in the folder, of fern on `images_8`.
    """
    folder = _linked(data / name, out / name)
    options = replace(SCENES[name].options, path=str(data / name), downscale=1.0)
    finer = replace(options, images="images_8") if name == "fern" else options
    few = _few(colmap_points(data / name / SIFT[name]) if name in SIFT else None, torch.Generator().manual_seed(0))
    began = time.process_time()
    cloud, about = dense_start(load_scene(finer, trains=False).train, few)
    write_points(folder / "finer.ply", cloud.positions, cloud.colors)
    print(f"{name}: {about}; {time.process_time() - began:.0f} s")


def _few(sift: PointCloud | None, generator: torch.Generator) -> PointCloud:
    """Return so many of the points that COLMAP found as it finds where it must find the cameras as well."""
    if sift is None:
        return PointCloud(torch.empty(0, 3), torch.empty(0, 3), "none", frozenset())
    some = torch.randperm(len(sift.positions), generator=generator)[:FEW]
    return replace(sift, positions=sift.positions[some], colors=sift.colors[some])


def with_many_photographs(data: Path, out: Path, name: str) -> None:
    """Write the folder of a scene of which `MANY` photographs train, with what COLMAP would find, and a dense start.

    The photographs are spread evenly over those that do not test. Of the points that were found in all of them, a share
    is taken as large as that of the photographs that train; the DTU scans have none.
    """
    folder = _linked(data / name, out / f"{name}-many")
    options = replace(SCENES[name].options, path=str(data / name))
    test = [view.name for view in load_scene(options, trains=False).test]
    everything = load_scene(replace(options, split="auto", test="none"), trains=False).train
    pool = [view for view in everything if view.name not in test]
    train = [pool[i] for i in evenly_spaced(len(pool), MANY[name])]
    (folder / "split_many.json").write_text(json.dumps({"train": [view.name for view in train], "test": test}))
    generator, measured = torch.Generator().manual_seed(0), colmap_points(data / name / "sparse/0")
    if measured is None:
        measured = PointCloud(torch.empty(0, 3), torch.empty(0, 3), "none", frozenset())
    some = torch.randperm(number := len(measured.positions), generator=generator)[
        : number * len(train) // len(everything)
    ]
    measured = replace(measured, positions=measured.positions[some], colors=measured.colors[some])
    if number:
        write_points(folder / "measured.ply", measured.positions, measured.colors)
    began = time.process_time()
    both, about = dense_start(train, measured)
    write_points(folder / "dense_and_measured.ply", both.positions, both.colors)
    print(f"{name}: {about}; {time.process_time() - began:.0f} s")


def _linked(source: Path, folder: Path) -> Path:
    """Make a folder with links to what is in another one, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in source.resolve().iterdir():
        if not (folder / path.name).exists():
            (folder / path.name).symlink_to(path)
    return folder


def write_points(path: Path, positions: Tensor, colors: Tensor) -> None:
    """Write a PLY of colored points."""
    kinds = {"x": "f4", "y": "f4", "z": "f4", "red": "u1", "green": "u1", "blue": "u1"}
    columns = [*positions.T.numpy(), *(255 * colors.clamp(0, 1)).round().T.byte().numpy()]
    rows = np.rec.fromarrays(columns, [*kinds.items()])
    properties = "".join(f"property {'float' if kind == 'f4' else 'uchar'} {name}\n" for name, kind in kinds.items())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(head.encode() + rows.tobytes())


def with_own_cameras(data: Path, out: Path, name: str) -> None:
    """Write a folder in which the training photographs tell the cameras, as for ``ca-reg run``, and the others test.

    The others are placed in the reconstruction of the training photographs, which stays as it is: by the points that
    they share with it, if they are `MIN_MATCHES` or more.
    """
    import pycolmap

    options = SCENES[name].options
    images = data / name / ("images_8" if name == "fern" else "images")  # of fern those of the README
    scene = load_scene(replace(options, path=str(data / name), images=images.name), trains=False)
    trained = [Path(view.name).name for view in scene.train]
    folder, three = out / f"{name}-own", out / f"{name}-own" / "three"
    (three / "images").mkdir(parents=True)
    for photo in trained:
        shutil.copy(images / photo, three / "images" / photo)
    print(f"{name}: {find_poses(three)}")
    shutil.copytree(images, folder / "images")
    model = pycolmap.Reconstruction(three / "sparse/0")
    trained = [image.name for image in model.images.values()]
    placed = _placed(model, folder / "images")
    for number, (photo, camera, pose) in enumerate(placed, start=max(model.images) + 1):
        model.add_image_with_trivial_frame(pycolmap.Image(name=photo, camera_id=camera, image_id=number), pose)
    (folder / "sparse/0").mkdir(parents=True)
    model.write_binary(folder / "sparse/0")
    split = {"train": sorted(trained), "test": [photo for photo, _, _ in placed]}
    (folder / "split.json").write_text(json.dumps(split))
    cloud = load_scene(SceneOptions(str(folder))).points
    write_points(folder / "dense_and_few.ply", cloud.positions, cloud.colors)
    print(f"{name}: {len(trained)} photographs tell the cameras, {len(placed)} of the others are placed")


def _placed(model: Any, images: Path) -> list[tuple[str, int, Any]]:
    """Return name, camera and pose of the photographs that a reconstruction lacks and that can be placed in it."""
    import pycolmap

    known = {image.name: image for image in model.images.values()}
    others = sorted(path.name for path in images.iterdir() if path.name not in known)
    features = pycolmap.FeatureExtractionOptions(max_image_size=LARGEST_SIDE)
    features.sift.estimate_affine_shape = features.sift.domain_size_pooling = True
    found = []
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "database.db"
        pycolmap.Database.open(path).close()
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
        for name in (*known, *others):
            pycolmap.import_images(
                path, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=[name], options=reader
            )
        larger = Path(work) / "photographs"
        sizes = enlarge([images / name for name in (*known, *others)], path, larger)
        pycolmap.extract_features(
            path, larger if sizes else images, image_names=[*known, *others], extraction_options=features
        )
        pycolmap.match_exhaustive(path)
        database = pycolmap.Database.open(path)
        ids, places = {}, {}
        for image in database.read_all_images():
            width = database.read_camera(image.camera_id).width
            by = sizes[image.camera_id][0] / width if image.camera_id in sizes else 1.0
            ids[image.name], places[image.name] = image.image_id, by * database.read_keypoints(image.image_id)[:, :2]
        points: dict[str, dict[int, int]] = {}  # of every known photograph: the point that a feature belongs to
        for name, image in known.items():
            own = [(feature.xy, feature.point3D_id) for feature in image.points2D if feature.has_point3D()]
            distances, nearest = cKDTree([xy for xy, _ in own]).query(places[name])
            points[name] = {i: own[k][1] for i, (d, k) in enumerate(zip(distances, nearest, strict=True)) if d < 0.05}
        for name in others:
            pairs = [
                (places[name][there], model.points3D[points[photo][here]].xyz)
                for photo in known
                for here, there in database.read_two_view_geometry(ids[photo], ids[name]).inlier_matches
                if here in points[photo]
            ]
            with Image.open(images / name) as picture:
                size = picture.size
            camera = next(camera for camera in model.cameras.values() if (camera.width, camera.height) == size)
            if len(pairs) >= MIN_MATCHES:
                seen = [np.array(part) for part in zip(*pairs, strict=True)]
                place = pycolmap.estimate_and_refine_absolute_pose(*seen, camera)
                if place is not None and place["num_inliers"] >= MIN_MATCHES:
                    found.append((name, camera.camera_id, place["cam_from_world"]))
        database.close()
    return found


if __name__ == "__main__":
    makers = {
        "points": with_points, "counts": with_counts, "finer": with_finer_points, "cameras": with_own_cameras,
        "many": with_many_photographs,
    }  # fmt: skip
    make = makers[sys.argv[1]]
    for scene in sys.argv[4:]:
        make(Path(sys.argv[2]), Path(sys.argv[3]), scene)
