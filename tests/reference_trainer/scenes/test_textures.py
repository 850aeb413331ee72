from __future__ import annotations

import pytest
import torch

from reference_trainer.scenes.synthetic import Noise, checker, color_ramp


@pytest.fixture
def noise():
    return Noise(torch.Generator().manual_seed(0))


def test_noise_is_the_lattice_value_on_the_lattice(noise):
    points = torch.tensor([[0.0, 0, 0], [3, 5, 7], [-1, 33, 2]])
    lattice = noise.lattice
    assert torch.equal(noise(points), torch.stack([lattice[0, 0, 0], lattice[3, 5, 7], lattice[31, 1, 2]]))


def test_noise_between_lattice_points_is_the_trilinear_mean_at_the_center(noise):
    lattice = noise.lattice
    torch.testing.assert_close(noise(torch.tensor([[4.5, 9.5, 2.5]]))[0], lattice[4:6, 9:11, 2:4].mean())


def test_noise_is_bounded_continuous_and_rougher_with_octaves(noise):
    line = torch.linspace(-5, 5, 20_001)
    points = torch.stack([line, 0.3 * line, 1 - line], dim=1)
    smooth, rough = noise(points), noise(points, octaves=4)
    for values, steepness in ((smooth, 1.0), (rough, 4 / 1.875)):
        assert values.min() >= 0
        assert values.max() <= 1
        # The fade has slope at most 1.5 and lattice values differ by at most 1. In every octave frequency times weight
        # is 1; the four weights sum to 1.875.
        assert values.diff().abs().max() <= 1.5 * (1 + 0.3 + 1) * (line[1] - line[0]) * steepness * 1.01
    assert rough.diff().diff().abs().mean() > 2 * smooth.diff().diff().abs().mean()


def test_color_ramp_hits_its_colors():
    colors = [(0.0, 0.2, 1.0), (1.0, 0.4, 0.5), (0.5, 0.0, 0.0)]
    at = torch.tensor([-1.0, 0.0, 0.5, 0.75, 1.0, 2.0])
    expected = torch.tensor([colors[0], colors[0], colors[1], (0.75, 0.2, 0.25), colors[2], colors[2]])
    torch.testing.assert_close(color_ramp(at, colors), expected)


def test_checker_alternates():
    u, v = torch.tensor([0.5, 1.5, 0.5, 1.5, -0.5, 0.02]), torch.tensor([0.5, 0.5, 1.5, 1.5, 0.5, 0.5])
    which, joint = checker(u, v, joint=0.1)
    assert which.tolist() == [0, 1, 1, 0, 1, 0]
    assert joint.tolist() == [False] * 5 + [True]
