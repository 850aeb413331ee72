import math

import torch

from reference_trainer.camera import Camera
from reference_trainer.scenes.scene import View


def test_a_resized_view_shows_the_same_at_the_same_place():
    # Colors linear across the picture, which an antialiased filter keeps away from the border: at any size the color of
    # a pixel is that of its center.
    camera = Camera(torch.eye(4), 50.0, 60.0, 20.0, 15.0, 40, 30)
    x, y = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(30) + 0.5, indexing="xy")
    across, down = x / 40, y / 30
    depth = torch.where(x < 20, 2.0, math.nan)
    view = View("a", camera, torch.stack([across, down, across * 0]), alpha=across, mask=down, depth_prior=depth)
    small = view.resized(20, 10)
    assert (small.camera.width, small.camera.height, small.camera.fx, small.camera.cy) == (20, 10, 25.0, 5.0)
    x, y = torch.meshgrid(torch.arange(20) + 0.5, torch.arange(10) + 0.5, indexing="xy")
    inside = slice(3, -3)
    for layer, expected in (
        (small.image[0], x / 20),
        (small.image[1], y / 10),
        (small.alpha, x / 20),
        (small.mask, y / 10),
    ):
        torch.testing.assert_close(layer[inside, inside], expected[inside, inside], rtol=0, atol=1e-6)
    assert (small.depth_prior[:, :10] == 2).all()
    assert small.depth_prior[:, 10:].isnan().all()
    assert small.depth is None
