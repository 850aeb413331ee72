"""Tile lists against an evaluation of every Gaussian at every pixel."""

import pytest
import torch
from oracles import random_scene

from reference_trainer.render import render, splat
from reference_trainer.render import tiles as tiles_module
from reference_trainer.render.constants import MIN_ALPHA, TILE


def alphas(splats, width, height):
    """alpha of every splat at every pixel centre, (M, H, W)."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx = x - splats.projection.means[:, 0, None, None]
    dy = y - splats.projection.means[:, 1, None, None]
    l11, l21, l22 = (f[:, None, None] for f in splats.projection.factors.unbind(1))
    return splats.opacities[:, None, None] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))


@pytest.mark.parametrize(("n", "width", "height", "size"), [(200, 53, 38, 0.05), (100, 64, 48, 0.4), (300, 9, 7, 0.02)])
def test_lists_hold_every_gaussian_that_counts_and_few_others(n, width, height, size):
    scene = random_scene(n, width, height, seed=n, size=size)
    splats = splat(*scene[:4], scene.camera, colors=scene.colors)
    lists = splats.lists
    counts = alphas(splats, width, height) >= MIN_ALPHA
    padded = torch.nn.functional.pad(counts, (0, lists.columns * TILE - width, 0, lists.rows * TILE - height))
    needed = padded.unfold(1, TILE, TILE).unfold(2, TILE, TILE).flatten(3).any(-1).flatten(1)  # (M, tiles)
    starts = lists.lengths.cumsum(0) - lists.lengths
    listed = torch.zeros_like(needed)
    for tile, (start, length) in enumerate(zip(starts.tolist(), lists.lengths.tolist(), strict=True)):
        members = lists.gaussians[start : start + length]
        assert members.unique().numel() == length
        depths = splats.projection.depths[members]
        assert (depths.diff() >= 0).all()
        listed[members, tile] = True
    assert not (needed & ~listed).any()
    # The ellipse test is exact for the rectangle spanned by the pixel centres, not for the centres: at most a few more.
    assert listed.sum() <= 1.5 * needed.sum() + 5
    assert torch.equal(lists.touched, listed.any(1))


@pytest.mark.parametrize("entries", [50, 1 << 19])
def test_blocks_cover_every_list_once_and_stay_within_their_budget(monkeypatch, entries):
    monkeypatch.setattr(tiles_module, "CHUNK_ENTRIES", entries)
    scene = random_scene(300, 70, 50, seed=1)
    lists = splat(*scene[:4], scene.camera, colors=scene.colors).lists
    budget = 4000
    seen, chunks = [], list(lists.chunks(budget))
    assert (len(chunks) > 1) == (entries == 50)
    for chunk in chunks:
        assert chunk.gaussians.numel() <= entries or len(chunk.blocks) == 1
        assert sum(block.shape[0] * block.shape[1] for block in chunk.blocks) == chunk.gaussians.numel()
        for block in chunk.blocks:
            tiles, longest = block.shape
            assert tiles * longest * TILE * TILE <= budget or tiles == 1
            numbers = chunk.tiles[block.tiles]
            rows, of = block.of(torch.stack([chunk.gaussians, chunk.tile_of])).unbind(0)
            assert torch.equal(of, numbers[:, None].expand(tiles, longest))
            for tile, row in zip(numbers.tolist(), rows, strict=True):
                length = int(lists.lengths[tile])
                start = int(lists.lengths[:tile].sum())
                assert torch.equal(row[:length], lists.gaussians[start : start + length])
                assert (row[length:] == lists.count).all()
                seen.append(tile)
    assert sorted(seen) == torch.nonzero(lists.lengths).squeeze(1).tolist()


def test_the_size_of_the_chunks_does_not_matter(monkeypatch):
    scene = random_scene(200, 50, 40, seed=6)
    images = []
    for entries in (30, 1 << 19):
        monkeypatch.setattr(tiles_module, "CHUNK_ENTRIES", entries)
        leaves = [x.clone().requires_grad_() for x in scene.tensors()]
        out = render(*leaves[:4], scene.camera, colors=leaves[4])
        (out.image.square().sum() + out.alpha.sum()).backward()
        images.append([out.image, out.alpha, *(x.grad for x in leaves)])
    for one, other in zip(*images, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13)


def test_equal_depths_keep_the_order_of_the_gaussians():
    scene = random_scene(4, 16, 16, seed=0)
    means = torch.zeros(4, 3, dtype=torch.float64)
    lists = splat(means, *scene[1:4], scene.camera, colors=scene.colors).lists
    first = lists.gaussians[: int(lists.lengths[0])]
    assert torch.equal(first, first.sort().values)
