"""How far cameras are off, whatever the world in which they were found."""

import numpy as np
from scipy.spatial.transform import Rotation


def camera_errors(found, true) -> tuple[float, float]:
    """Largest errors of a rotation, degrees, and of a center, by the largest distance, after the best similarity.

    The rotation between the worlds is the mean of those that the cameras tell.
    """
    (turns, p), (true_turns, q) = _axes_and_centers(found), _axes_and_centers(true)
    between = true_turns.inv() * turns
    world = between.mean()
    p, q = world.apply(p - p.mean(0)), q - q.mean(0)
    apart = np.linalg.norm((p * q).sum() / (p**2).sum() * p - q, axis=1).max()
    degrees = np.degrees((between * world.inv()).magnitude().max())
    return float(degrees), float(apart / np.linalg.norm(q[:, None] - q, axis=2).max())


def _axes_and_centers(cameras):
    axes = np.array([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])
    return Rotation.from_matrix(axes), np.array([camera.position.double().numpy() for camera in cameras])
