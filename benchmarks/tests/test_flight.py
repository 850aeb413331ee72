import math

import numpy as np
import pytest
import torch

from benchmarks.flight import sheets, there_and_back
from reference_trainer.camera import Camera
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians


def camera(x):
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(pose, 30.0, 30.0, 20.0, 15.0, 40, 30)


def test_the_flight_begins_before_the_first_camera_and_ends_beyond_the_last():
    path = there_and_back([camera(x) for x in (0.0, 1.0, 3.0)], 9, past=0.25)
    along = [x.position[0].item() for x in path]
    assert along[0] == pytest.approx(-0.25)
    assert along[4] == pytest.approx(1.0)  # halfway
    assert along[-1] == pytest.approx(3.5)  # a quarter of the segment of length 2
    assert along == sorted(along)
    segment = (1 - 1.25 * math.cos(math.pi / 8)) - -0.25
    assert along[1] - along[0] == pytest.approx(segment)  # slowly at the ends


def test_a_sheet_has_a_column_for_each_model_with_the_map_of_its_score_below():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=generator) * 2 - 1 + torch.tensor([0.0, 0.0, 3.0])
    gaussians = Gaussians.from_points(
        points, torch.rand(200, 3, generator=generator), torch.full((200,), 0.3), sh_degree=0
    )
    model = TrainedModel(gaussians, torch.zeros(3))
    black = TrainedModel(gaussians.map(torch.zeros_like)[:1], torch.zeros(3))
    (sheet,) = sheets([model, black], ["one", "other"], [camera(0.0)])
    pixels = torch.from_numpy(np.array(sheet))
    one, other = pixels[22:52, :40], pixels[22:52, 44:84]
    assert one.float().std() > 10 > other.float().std()
    assert (pixels[:22, :40] < 128).any(), "the label has ink"
    bar = pixels[74:104, 88:104].float().mean((1, 2))
    assert bar[0] > 150 > 30 > bar[-1]
