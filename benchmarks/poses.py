"""Cameras found from the training photographs alone, against those that COLMAP found from all photographs.

    python -m benchmarks.poses ../shared/data SCENE...    # prints a table

Errors are the largest of the three cameras, after the best similarity.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.paper.scenes import SCENES
from reference_trainer.camera import Camera
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.poses import find_poses

__all__ = ["errors", "line"]

COMPARED = ("fern", "herz-jesu", "fountain", "sceaux", "cape")
"""Scenes of photographs by COLMAP's cameras; of DTU's, taken from places far apart, two of three are placed."""


def errors(found: list[Camera], true: list[Camera]) -> tuple[float, float, float]:
    """Return the largest errors of rotations, degrees, and centers, by the largest distance; and the focal length's."""
    (turns, p), (true_turns, q) = _axes_and_centers(found), _axes_and_centers(true)
    u, _, v = np.linalg.svd(np.einsum("nij,nik->jk", true_turns, turns))  # the rotation between the two worlds
    world = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    p, q = (p - p.mean(0)) @ world.T, q - q.mean(0)
    apart = np.linalg.norm((p * q).sum() / (p**2).sum() * p - q, axis=1).max()
    cosines = [(np.trace(b.T @ a @ world.T) - 1) / 2 for a, b in zip(turns, true_turns, strict=True)]
    degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1))).max()
    focal = found[0].fx / found[0].width / (true[0].fx / true[0].width) - 1
    return float(degrees), float(apart / np.linalg.norm(q[:, None] - q, axis=2).max()), float(focal)


def _axes_and_centers(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    axes = np.array([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])
    return axes, np.array([camera.position.double().numpy() for camera in cameras])


def line(data: Path, name: str) -> dict[str, str]:
    """Return a line of the table."""
    images = "images_8" if name == "fern" else "images"
    options = replace(SCENES[name].options, path=str(data / name), images=images, downscale=1.0, points="random:100")
    true = load_scene(options, trains=False).train
    with tempfile.TemporaryDirectory() as work:
        for view in true:
            shutil.copy(data / name / images / Path(view.name).name, work)
        begun = time.process_time()
        result = find_poses(work)
        seconds = time.process_time() - begun
        scene = load_scene(SceneOptions(work, points="random:100"), trains=False)
    cameras = {Path(view.name).name: view.camera for view in scene.train}
    placed = [view for view in true if Path(view.name).name in cameras]
    degrees, apart, focal = errors([cameras[Path(view.name).name] for view in placed], [view.camera for view in placed])
    return {
        "scene": f"{name} {true[0].camera.width}x{true[0].camera.height}", "placed": f"{len(placed)} of {len(true)}",
        "points": f"{result.points:,}", "rotation": f"{degrees:.2f} degrees", "centers": f"{apart:.1%}",
        "focal length": f"{focal:+.1%}", "processor s": f"{seconds:.0f}",
    }  # fmt: skip


if __name__ == "__main__":
    lines = [line(Path(sys.argv[1]), name) for name in sys.argv[2:] or COMPARED]
    print(markdown_table(lines, [*lines[0]]))
