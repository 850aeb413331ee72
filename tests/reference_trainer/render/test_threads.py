"""The loops in several threads: equal bits, several callers, errors, and Ctrl-C."""

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from oracles import random_scene

from ca_reg.functional import Multiplier
from reference_trainer.render import rasterize, render_masks, render_moments, splat, variance_shares
from reference_trainer.render.constants import TILE

pytest.importorskip("numba")
from reference_trainer.compiled.threads import in_threads


@pytest.fixture(autouse=True)
def loops(monkeypatch):
    """The loops, and as many threads as before at the end."""
    monkeypatch.setenv("CA_REG_ENGINE", "numba")
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def everything(scene):
    """Every result of the loops, and every gradient."""
    sh = (scene.colors[:, None] - 0.5).repeat(1, 9, 1) / 3
    leaves = [x.clone().requires_grad_() for x in (*scene[:4], sh)]
    splats = splat(*leaves[:4], scene.camera, sh=leaves[4])
    out = rasterize(splats, depth=True)
    kept = rasterize(splats.engine.masked(splats, splats.opacities * (splats.indices % 2)))
    masks = render_masks(
        splats, scene.opacities * torch.stack([torch.arange(len(sh)) % n for n in (2, 3, 4)]).clamp(max=1)
    )
    moments = render_moments(splats, Multiplier.dropout(0.4))
    images = (out.image, out.alpha, out.depth, kept.image, moments.mean, moments.variance, moments.alpha_mean)
    sum((x * torch.linspace(-1, 1, x.numel()).view(x.shape)).sum() for x in images).backward()
    shares = variance_shares(splats, Multiplier.dropout(0.4), torch.ones_like(out.alpha))
    lists = splats.lists
    return [*images, *masks, shares, lists.starts, lists.gaussians, lists.slots, *(x.grad for x in leaves)]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_number_of_threads_changes_no_bit(seed):
    # So many Gaussians and tiles that every loop is divided, at other places for every number of threads.
    scene = random_scene(9001 + 502 * seed, 203, 117 + 30 * seed, seed=seed, size=0.02).to(torch.float32)
    results = []
    for threads in (1, 2, 3, 4):
        torch.set_num_threads(threads)
        results.append(everything(scene))
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))


def test_several_threads_render_at_once():
    torch.set_num_threads(2)
    scenes = [random_scene(1500, 101, 67, seed=seed, size=0.05).to(torch.float32) for seed in range(4)]
    alone = [everything(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            for one, other in zip(alone, pool.map(everything, scenes), strict=True):
                assert all(torch.equal(x, y) for x, y in zip(one, other, strict=True))


def test_every_item_is_worked_on_once_by_as_many_threads_as_torch_has():
    torch.set_num_threads(3)
    seen, threads = [], set()

    def loop(first, last, step):
        time.sleep(0.002)
        threads.add(threading.get_ident())
        seen.extend(range(first, last, step))

    in_threads(loop, 1000, 1, least=10)
    assert sorted(seen) == list(range(1000))
    assert len(threads) == 3
    seen.clear()
    in_threads(loop, 9, 1, least=10)
    assert seen == list(range(9))


@pytest.mark.parametrize("where", ["first range", "other thread"])
def test_an_error_surfaces_and_nothing_is_written_after_it(where):
    torch.set_num_threads(3)
    main, written = threading.get_ident(), []

    def loop(first, last):
        if (threading.get_ident() == main) == (where == "first range"):
            raise ZeroDivisionError("in the loop")
        time.sleep(0.01)
        written.append(first)

    with pytest.raises(ZeroDivisionError, match="in the loop"):
        in_threads(loop, 100, least=1)
    count = len(written)
    time.sleep(0.05)
    assert len(written) == count
    assert count <= 50  # ranges


@pytest.mark.parametrize("times", [1, 2], ids=["once", "again while it waits for the others"])
def test_after_ctrl_c_nothing_is_written(times):
    torch.set_num_threads(3)
    main, written, begun = threading.get_ident(), [], threading.Event()

    def press():
        signal.pthread_kill(main, signal.SIGINT)

    def loop(first, last):
        if threading.get_ident() == main:
            begun.wait(10)  # until the others are in the middle of a range
            if times == 2:
                threading.Timer(0.05, press).start()
            signal.raise_signal(signal.SIGINT)
        begun.set()
        time.sleep(0.2)
        written.append(first)

    with pytest.raises(KeyboardInterrupt):
        in_threads(loop, 100, least=1)
    count = len(written)
    assert count <= 2  # the two ranges that had begun: no further one was taken
    time.sleep(0.3)
    assert len(written) == count


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of one during garbage collection
def test_renders_go_on_after_ctrl_c_at_any_time():
    torch.set_num_threads(3)
    scene = random_scene(3000, 160, 120, seed=3, size=0.04).to(torch.float32)
    expected = everything(scene)
    interrupted, before = 0, signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
    try:
        for i in range(30):
            try:
                with torch.enable_grad():  # torch's no_grad, interrupted on its way out, leaves gradients off
                    signal.setitimer(signal.ITIMER_REAL, 0.002 + 0.003 * i)
                    everything(scene)
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                interrupted += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert interrupted > 0
    assert all(torch.equal(x, y) for x, y in zip(expected, everything(scene), strict=True))


def test_no_loop_is_compiled_again_for_views_of_tensors():
    from reference_trainer.compiled.compiling import KERNELS

    scene = random_scene(40, 3 * TILE, 2 * TILE, seed=1).to(torch.float32)
    everything(scene)
    before = {kernel.__name__: kernel.signatures for kernel in KERNELS}

    def strided(x):
        return torch.stack([x, x], dim=-1)[..., 0].requires_grad_()

    for change in (strided, lambda x: x[:1].expand(x.shape)):
        leaves = [change(x) for x in scene.tensors()]
        for opacities in (leaves[3], leaves[3][:, None]):
            splats = splat(*leaves[:3], opacities, scene.camera, colors=leaves[4])
            out = rasterize(splats, background=strided(torch.rand(3)), depth=True)
            out.image[:, ::2].sum().backward(retain_graph=True) if out.image.requires_grad else None
            rasterize(splats.engine.masked(splats, change(0.5 * splats.opacities.detach())))
            render_masks(splats, change(0.5 * opacities.detach().reshape(-1)).expand(2, -1))
            backdrop = torch.rand(2 * TILE, 3 * TILE, 3).permute(2, 0, 1)
            moments = render_moments(splats, Multiplier(strided(torch.rand(40)), 0.2), background=backdrop)
            moments.variance.permute(2, 1, 0).sum().backward()
            variance_shares(splats, Multiplier.dropout(0.5), torch.ones(1, 1).expand(2 * TILE, 3 * TILE))
    assert {kernel.__name__: kernel.signatures for kernel in KERNELS} == before
