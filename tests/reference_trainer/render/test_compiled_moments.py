"""Compiled moments against eager ones: the algorithm operation by operation in float64, then compiled in float32."""

import warnings

import pytest
import torch
from oracles import random_scene

from ca_reg.functional import Multiplier
from reference_trainer.render import compiled, compiled_moments, splat
from reference_trainer.render.compiled import is_compiled, use_compiled
from reference_trainer.render.moments import render_moments
from reference_trainer.render.tiles import TileLists

BACKGROUND = torch.tensor([0.3, 0.9, 0.1])


@pytest.fixture
def uncompiled(monkeypatch):
    """The compiled path, its functions run as they are written."""
    monkeypatch.setitem(compiled._state, "compiled", True)
    monkeypatch.setattr(compiled_moments, "kernel", lambda function, *arguments: function(*arguments))


@pytest.fixture
def working_compiler():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not use_compiled():
            pytest.skip("there is no working compiler")
    yield
    use_compiled(False)


def results(scene, multiplier, alpha=True):
    """The moments and all gradients of a random weighting of them."""
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    background = BACKGROUND.to(scene.means).requires_grad_()
    splats = splat(*leaves[:4], scene.camera, colors=leaves[4])
    images = [x for x in render_moments(splats, multiplier, background=background, alpha=alpha) if x is not None]
    stacked = torch.cat([x.reshape(-1, *x.shape[-2:]) for x in images])
    g = torch.Generator().manual_seed(0)
    (stacked * torch.randn(stacked.shape, generator=g).to(stacked)).sum().backward()
    factors = [x.grad for x in (multiplier.mean, multiplier.variance) if isinstance(x, torch.Tensor)]
    return [stacked.detach(), *(x.grad for x in leaves), background.grad, *factors]


def each(n):
    m, v = torch.rand(2, n, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return Multiplier(m.requires_grad_(), v.requires_grad_())


def eager(monkeypatch, *arguments):
    with monkeypatch.context() as m:
        m.setitem(compiled._state, "compiled", False)
        return results(*arguments)


@pytest.mark.parametrize("make", [lambda n: Multiplier.dropout(0.3), each], ids=["shared", "one each"])
@pytest.mark.parametrize(("n", "width", "height"), [(150, 37, 21), (3, 16, 8), (40, 9, 8)])
@pytest.mark.usefixtures("uncompiled")
def test_it_is_the_same_recursion(n, width, height, make, monkeypatch):
    scene = random_scene(n, width, height, seed=2)
    for mine, other in zip(results(scene, make(n)), eager(monkeypatch, scene, make(n)), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-12)


@pytest.mark.usefixtures("uncompiled")
def test_chunks_of_few_entries_make_no_difference(monkeypatch):
    scene, whole = random_scene(150, 37, 21, seed=2), each(150)
    before = results(scene, whole)
    monkeypatch.setattr(compiled_moments, "_CHUNK", 20)
    for mine, other in zip(results(scene, each(150)), before, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-12)


def test_slices_hold_every_entry_once_and_in_order():
    scene = random_scene(90, 37, 21, seed=4)
    lists: TileLists = splat(*scene[:4], scene.camera, colors=scene.colors).lists
    ends = lists.lengths.cumsum(0).tolist()
    for entries in (1, 50, 10_000):
        found = {}
        for chunk in lists.slices(entries):
            assert chunk.tiles.shape[0] >= 2
            for block in chunk.blocks:
                assert block.shape[0] >= 2
                rows = chunk.gaussians[block.entries].view(block.shape)
                of_tiles = chunk.tile_of[block.entries].view(block.shape)
                assert torch.equal(of_tiles, chunk.tiles[block.tiles, None].expand(block.shape))
                for tile, row in zip(chunk.tiles[block.tiles].tolist(), rows, strict=True):
                    found.setdefault(tile, []).extend(row[row < lists.count].tolist())
        for tile, (length, end) in enumerate(zip(lists.lengths.tolist(), ends, strict=True)):
            assert found.get(tile, []) == lists.gaussians[end - length : end].tolist()


@pytest.mark.slow  # compiles three loops
@pytest.mark.usefixtures("working_compiler")
def test_compiled_agrees_with_eager_within_rounding(monkeypatch):
    scene = random_scene(300, 70, 50, seed=6, size=0.2).to(torch.float32)
    assert is_compiled(torch.device("cpu"))
    mine = results(scene, Multiplier.dropout(0.5), False)
    other = eager(monkeypatch, scene, Multiplier.dropout(0.5), False)
    assert (mine[0] - other[0]).abs().max() < 1e-5
    for x, y in zip(mine[1:], other[1:], strict=True):
        assert (x - y).norm() < 1e-4 * y.norm()


def test_what_was_compiled_for_other_instructions_is_not_taken_from_the_disk(monkeypatch):
    config = pytest.importorskip("torch.compiler.config", reason="torch has had it since 2.6")
    before, tags = config.cache_key_tag, []
    monkeypatch.setattr(compiled, "_compile", lambda function: lambda *arguments: tags.append(config.cache_key_tag))
    monkeypatch.setattr(compiled, "_known", set())
    compiled.kernel(print, torch.zeros(1), torch.zeros(2, 1))
    assert torch.backends.cpu.get_cpu_capability() in tags[0]  # the first call compiles
    assert config.cache_key_tag == before


def test_without_a_compiler_it_says_so_and_stays_eager(monkeypatch):
    def broken(*args, **kwargs):
        raise RuntimeError("no g++ here\n\nand a long story")

    monkeypatch.setattr(torch, "compile", broken)
    compiled._obstacle.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"moments are not compiled: .*RuntimeError: no g\+\+ here\)"):
            assert not use_compiled()
        assert not is_compiled(torch.device("cpu"))
    finally:
        compiled._obstacle.cache_clear()
