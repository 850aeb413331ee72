"""Tile lists against an evaluation of every Gaussian at every pixel."""

import itertools

import pytest
import torch
from oracles import random_scene

from reference_trainer.render import splat
from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.torch import compositing

ROUNDING = {torch.float64: 1e-9, torch.float32: 1e-3}  # of an alpha, relative


def alphas(splats, width, height):
    """The largest alpha of every splat at the pixel centers of every tile, in float64, (M, tiles)."""
    means, factors, opacities = (x.double() for x in (*splats.projection[:2], splats.opacities))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = x - means[:, 0, None, None], y - means[:, 1, None, None]
    l11, l21, l22 = (f[:, None, None] for f in factors.unbind(1))
    alpha = opacities[:, None, None] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))
    columns, rows = -(-width // TILE), -(-height // TILE)
    padded = torch.nn.functional.pad(alpha, (0, columns * TILE - width, 0, rows * TILE - height))
    return padded.unfold(1, TILE, TILE).unfold(2, TILE, TILE).flatten(3).amax(-1).flatten(1)


def listed(splats):
    """Whether a splat is in the list of a tile, (M, tiles); checks on the way that nobody is listed twice."""
    lists = splats.lists
    table = torch.zeros(len(splats.opacities), lists.rows * lists.columns, dtype=torch.bool)
    starts = lists.starts.tolist()
    for tile, (start, end) in enumerate(itertools.pairwise(starts)):
        members = lists.gaussians[start:end].long()
        assert members.unique().numel() == end - start
        assert (splats.projection.depths[members].diff() >= 0).all()
        table[members, tile] = True
    assert starts[-1] == len(lists.gaussians)
    return table


@pytest.mark.parametrize(("n", "width", "height", "size"), [(200, 53, 38, 0.05), (100, 64, 48, 0.4), (300, 9, 7, 0.02)])
def test_lists_hold_every_gaussian_that_counts_and_few_others(n, width, height, size, case):
    scene = random_scene(n, width, height, seed=n, size=size).to(case.dtype)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    table, largest = listed(splats), alphas(splats, width, height)
    assert not ((largest >= MIN_ALPHA * (1 + ROUNDING[case.dtype])) & ~table).any()
    # The ellipse test is exact for the rectangle spanned by the pixel centers, not for the centers: at most a few more.
    assert table.sum() <= 1.5 * (largest >= MIN_ALPHA).sum() + 5
    assert torch.equal(splats.lists.touched, table.any(1))


def test_both_engines_list_the_same_but_for_what_touches_a_tile_by_rounding(monkeypatch):
    pytest.importorskip("numba")
    scene, tables = random_scene(400, 61, 43, seed=3, size=0.15).to(torch.float32), []
    for name in ("torch", "numba"):
        monkeypatch.setenv("CA_REG_ENGINE", name)
        splats = splat(*scene[:4], scene.camera, colors=scene.colors)
        assert splats.engine.name == name
        tables.append(listed(splats))
    differing = tables[0] != tables[1]
    assert differing.sum() <= 0.002 * tables[0].sum()
    assert (alphas(splats, 61, 43)[differing] < MIN_ALPHA * (1 + ROUNDING[torch.float32])).all()


def test_the_rows_of_a_gaussian_are_its_own_and_follow_each_other(monkeypatch):
    """A row for every entry, those of a Gaussian in sequence: so no sum depends on the threads."""
    pytest.importorskip("numba")
    monkeypatch.setenv("CA_REG_ENGINE", "numba")
    scene = random_scene(150, 50, 30, seed=5, size=0.2).to(torch.float32)
    lists = splat(*scene[:4], scene.camera, colors=scene.colors).lists
    assert lists.slots.sort().values.tolist() == list(range(len(lists.gaussians)))
    owner = torch.repeat_interleave(torch.arange(len(lists.touched)), lists.offsets.diff())
    assert torch.equal(owner[lists.slots.long()], lists.gaussians.long())


def test_equal_depths_keep_the_order_of_the_gaussians(case):
    scene = random_scene(4, 16, 16, seed=0).to(case.dtype)
    means = torch.zeros(4, 3, dtype=case.dtype)
    lists = splat(means, *scene[1:4], scene.camera, colors=scene.colors).lists
    first = lists.gaussians[: int(lists.lengths[0])]
    assert len(first) > 1
    assert torch.equal(first, first.sort().values)


@pytest.mark.parametrize("budget", [1, 4000, 1 << 30])
def test_blocks_hold_every_list_once_whatever_their_size(budget, monkeypatch):

    monkeypatch.setattr(compositing, "BLOCK_PAIRS_CPU", budget)
    scene = random_scene(300, 70, 50, seed=1)
    lists = splat(*scene[:4], scene.camera, colors=scene.colors).lists
    starts, found = lists.starts.tolist(), {}
    for block in compositing.blocks(lists, torch.device("cpu")):
        assert block.gaussians.numel() * compositing.PIXELS <= budget or len(block.tiles) == 1
        for tile, row in zip(block.tiles.tolist(), block.gaussians.tolist(), strict=True):
            assert tile not in found
            length = starts[tile + 1] - starts[tile]
            found[tile], padding = row[:length], row[length:]
            assert set(padding) <= {len(lists.touched)}
    assert found == {
        tile: lists.gaussians[a:b].tolist() for tile, (a, b) in enumerate(itertools.pairwise(starts)) if b > a
    }


@pytest.mark.parametrize(("gibibytes", "pairs"), [(80, 1 << 25), (8, 1 << 23)])
def test_blocks_take_a_fraction_of_what_a_card_has(gibibytes, pairs, monkeypatch):
    class Properties:
        total_memory = gibibytes << 30

    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: Properties)
    assert compositing.block_pairs(torch.device("cuda")) == pairs
