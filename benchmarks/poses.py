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

from benchmarks.paper.scenes import SCENES
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.poses import find_poses
from tests.camera_errors import camera_errors

__all__ = ["line"]

COMPARED = ("fern", "herz-jesu", "fountain", "sceaux", "cape")
"""Scenes of photographs by COLMAP's cameras; of DTU's, taken from places far apart, two of three are placed."""


def line(data: Path, name: str) -> dict[str, str]:
    """Return a line of the table."""
    images = "images_8" if name == "fern" else "image" if name.startswith("dtu") else "images"
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
    found = [cameras[Path(view.name).name] for view in placed]
    degrees, apart = camera_errors(found, [view.camera for view in placed])
    lengths = [camera.fx / camera.width for camera in (found[0], true[0].camera)]
    return {
        "scene": f"{name} {true[0].camera.width}x{true[0].camera.height}", "placed": f"{len(placed)} of {len(true)}",
        "points": f"{result.points:,}", "rotation": f"{degrees:.2f} degrees", "centers": f"{apart:.1%}",
        "focal length": f"{lengths[0] / lengths[1] - 1:+.1%}", "processor s": f"{seconds:.0f}",
    }  # fmt: skip


if __name__ == "__main__":
    lines = [line(Path(sys.argv[1]), name) for name in sys.argv[2:] or COMPARED]
    print(markdown_table(lines, [*lines[0]]))
