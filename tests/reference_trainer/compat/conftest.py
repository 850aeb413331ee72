"""What the stand-in's tests share: the settings tuple of a camera, and where a single splat may be moved."""

from collections.abc import Callable

import pytest
import torch
from oracles import GaussianScene, brute_force
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.compat.rasterizer import GaussianRasterizationSettings


def _settings_of(camera: Camera, **changes) -> GaussianRasterizationSettings:
    pose = camera.world_to_camera
    projection = pose.new_zeros(4, 4)  # textbook order: a column vector (x, y, z, 1) to clip space
    projection[0, 0], projection[0, 2] = 2 * camera.fx / camera.width, 2 * camera.cx / camera.width - 1
    projection[1, 1], projection[1, 2] = 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = 1.0001, -0.01, 1.0
    fields = {
        "image_height": camera.height,
        "image_width": camera.width,
        "tanfovx": 0.5 * camera.width / camera.fx,
        "tanfovy": 0.5 * camera.height / camera.fy,
        "bg": pose.new_zeros(3),
        "scale_modifier": 1.0,
        "viewmatrix": pose.T,
        "projmatrix": (projection @ pose).T,
        "sh_degree": 0,
        "campos": camera.position,
    }
    return GaussianRasterizationSettings(**{**fields, **changes})


@pytest.fixture
def settings_of() -> Callable[..., GaussianRasterizationSettings]:
    """A function: the settings of a camera, as a repository would build them."""
    return _settings_of


class _MovedCamera:
    """A camera whose principal point is another one for every Gaussian that the brute-force renderer renders."""

    def __init__(self, camera: Camera, shifts: Tensor, order: list[int]) -> None:
        self._camera, self._shifts = camera, shifts
        self._x, self._y = iter(order), iter(order)

    def __getattr__(self, name: str):
        return getattr(self._camera, name)

    @property
    def cx(self) -> Tensor:
        return self._camera.cx + self._shifts[next(self._x), 0]

    @property
    def cy(self) -> Tensor:
        return self._camera.cy + self._shifts[next(self._y), 1]


def _moved_brute_force(scene: GaussianScene, colors: Tensor, shifts: Tensor) -> tuple[Tensor, Tensor]:
    depths = (scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2]
    order = [i for i in torch.argsort(depths).tolist() if depths[i] > 0.2]
    return brute_force(*scene[:4], colors, _MovedCamera(scene.camera, shifts, order))


@pytest.fixture
def moved_brute_force() -> Callable[[GaussianScene, Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The brute-force renderer with every splat moved on the picture by its row of shifts (N, 2), pixels."""
    return _moved_brute_force
