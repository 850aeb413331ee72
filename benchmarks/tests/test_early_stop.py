"""Where lists are cut, against a loop over the entries of every pixel."""

import torch

from benchmarks.early_stop import cut
from ca_reg.lists import PixelLists


def test_a_list_ends_before_what_would_leave_too_little_light():
    g = torch.Generator().manual_seed(0)
    pixels = torch.randint(6, (120,), generator=g)
    alphas = 0.99 * torch.rand(120, generator=g, dtype=torch.float64)
    lists = PixelLists(torch.arange(120), pixels, alphas, torch.zeros(120, 3, dtype=torch.float64), 2, 3)
    expected = set()
    for pixel in range(6):
        light = 1.0
        for entry in (pixels == pixel).nonzero().flatten().tolist():
            light *= 1 - alphas[entry].item()
            if light <= 1e-4:
                break
            expected.add(entry)
    assert 10 < len(expected) < 110
    assert set(cut(lists).gaussians.tolist()) == expected
