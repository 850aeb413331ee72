"""The training views and initial points of a scene in the files that repositories of the INRIA family read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.interpolate import NearestNDInterpolator
from scipy.spatial.transform import Rotation

from reference_trainer.scenes.depth import point_prior
from reference_trainer.scenes.pseudo import depth_bounds
from reference_trainer.scenes.scene import Scene

__all__ = ["write_scene"]


def write_scene(scene: Scene, folder: Path) -> None:
    """Write the training views and initial points for the forks: COLMAP text, PLY, LLFF bounds, depth as PNG."""
    assert scene.points is not None
    sparse = folder / "sparse/0"
    for each in (sparse, folder / "images", folder / "depth", folder / "depth_maps", folder / "3_views/dense"):
        each.mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for number, view in enumerate(sorted(scene.train, key=lambda view: view.name), start=1):
        camera, stem = view.camera, Path(view.name).stem
        cameras.append(
            f"{number} PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}\n"
        )
        pose = camera.world_to_camera.double().numpy()
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        images.append(" ".join(map(str, [number, *turn, *pose[:3, 3], number, f"{stem}.png"])) + "\n\n")
        pixels = (view.image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(folder / f"images/{stem}.png")
        prior = point_prior(view, scene.points).depth_prior.numpy()
        known = np.isfinite(prior)
        full = NearestNDInterpolator(np.argwhere(known), prior[known])(*np.indices(prior.shape))
        near = Image.fromarray((255 * (1 / full - (1 / full).min()) / np.ptp(1 / full)).round().astype(np.uint8))
        near.save(folder / f"depth/{stem}.png")
        near.save(folder / f"depth_maps/depth_{stem}.png")
    (sparse / "cameras.txt").write_text("".join(cameras))
    (sparse / "images.txt").write_text("".join(images))
    names = [
        *((axis, "<f4") for axis in ("x", "y", "z", "nx", "ny", "nz")),
        *((c, "u1") for c in ("red", "green", "blue")),
    ]
    rows = np.zeros(len(scene.points.positions), names)
    for axis, values in zip("xyz", scene.points.positions.T, strict=True):
        rows[axis] = values
    for color, values in zip(("red", "green", "blue"), scene.points.colors.T, strict=True):
        rows[color] = (values * 255).round()
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    for ply in (sparse / "points3D.ply", folder / "3_views/dense/fused.ply"):
        ply.write_bytes(header.encode() + rows.tobytes())
    np.save(sparse / "confidence_dsp.npy", np.zeros((len(rows), 1)))  # of the points, for InstantSplat
    if not (folder / "sparse_3").exists():
        (folder / "sparse_3").symlink_to("sparse")
    np.save(folder / "poses_bounds.npy", np.tile([0.0] * 15 + list(depth_bounds(scene)), (len(scene.train), 1)))
