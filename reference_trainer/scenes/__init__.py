"""Scenes: photographs with cameras and initial points, from COLMAP, LLFF and Blender files or built in.

``load_scene`` is the way in; ``Scene`` is all that the rest of the program sees.
"""

from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.points import check_no_leak, mean_neighbor_distance
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.scenes.synthetic import synthetic_scene

__all__ = [
    "PointCloud",
    "Scene",
    "View",
    "check_no_leak",
    "load_scene",
    "mean_neighbor_distance",
    "synthetic_scene",
]
