"""gsplat itself, its strategies and its launcher of processes, with the stand-ins in place."""

import sys
from types import ModuleType

import pytest
import torch
from oracles import random_scene
from stand_ins.gsplat import intrinsics

from reference_trainer.compat import stand_in
from reference_trainer.compat.gsplat import quat_scale_to_covar_preci

gsplat = pytest.importorskip("gsplat")
N, WIDTH, HEIGHT = 80, 24, 18


def train(strategy, steps=12):
    """Train as gsplat's trainer does; returns the losses and the number of Gaussians at the end."""
    torch.manual_seed(0)
    scene = random_scene(N, WIDTH, HEIGHT, seed=2, size=0.3).to(torch.float32)
    raw = {"means": scene.means, "quats": scene.quaternions, "scales": scene.scales.log()}
    raw |= {"opacities": torch.logit(0.5 * scene.opacities), "colors": torch.logit(scene.colors)}
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(x.clone()) for k, x in raw.items()}).to("cuda:0")
    optimizers = {k: torch.optim.Adam([{"params": x, "lr": 0.02, "name": k}]) for k, x in params.items()}
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    for step in range(1, steps + 1):  # older versions reset the opacities at step 0
        image, _, info = gsplat.rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["colors"].sigmoid(), scene.camera.world_to_camera[None], intrinsics(scene.camera)[None].float(),
            WIDTH, HEIGHT, packed=False, absgrad=getattr(strategy, "absgrad", False),
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - 0.6).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        more = {"lr": 1e-6} if isinstance(strategy, gsplat.MCMCStrategy) else {}
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
        losses.append(loss.item())
    return losses, len(params["means"])


@pytest.mark.parametrize(
    "strategy",
    [
        lambda: gsplat.DefaultStrategy(refine_start_iter=2, refine_every=4, grow_grad2d=1e-3, absgrad=True),
        lambda: gsplat.MCMCStrategy(refine_start_iter=2, refine_every=4),
    ],
    ids=["default", "mcmc"],
)
def test_strategies_train_and_grow(strategy):
    with stand_in() as modules:
        assert modules == ("fused_ssim",)
        losses, count = train(strategy())
    assert losses[-1] < 0.8 * losses[0]
    assert count > N


def test_everything_is_replaced_everywhere_and_restored():
    from gsplat import distributed, rendering, strategy

    def functions():
        return (
            gsplat.rasterization, rendering.rasterization, rendering.rasterization_2dgs, distributed.cli,
            strategy.ops.compute_relocation, strategy.ops.quat_scale_to_covar_preci,
        )  # fmt: skip

    before = functions()
    with stand_in():
        within = functions()
        assert all(a is not b for a, b in zip(within, before, strict=True))
        assert within[0] is within[1]
        ran = []
        assert distributed.cli(lambda *given: ran.append(given), "settings", verbose=True)
        assert ran == [(0, 0, 1, "settings")]
    assert functions() == before
    assert {"fused_ssim", "gsplat.csrc"}.isdisjoint(sys.modules)


def test_what_needs_cuda_says_so_by_its_name():
    with stand_in():
        with pytest.raises(RuntimeError, match=r"gsplat\.rasterization_2dgs .*CUDA .*MCMC"):
            gsplat.rasterization_2dgs()
        with pytest.raises(RuntimeError, match=r"gsplat\.\w+_fwd .* needs CUDA"):
            gsplat.spherical_harmonics(0, torch.ones(1, 3), torch.ones(1, 1, 3))


def test_without_gsplat_its_name_is_in_the_message(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match="gsplat: pip install"), stand_in():
        pass


@pytest.mark.parametrize("triu", [True, False])
def test_covariances_are_gsplats(triu):
    own = pytest.importorskip("gsplat.cuda._torch_impl")
    generator = torch.Generator().manual_seed(1)
    quats, scales = (
        torch.randn(7, 4, generator=generator).double(),
        torch.rand(7, 3, generator=generator).double() + 0.1,
    )
    for ours, theirs in zip(
        quat_scale_to_covar_preci(quats, scales, triu=triu),
        own._quat_scale_to_covar_preci(quats, scales, triu=triu),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    assert quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None


def test_an_old_gsplat_is_told_from_a_missing_one(monkeypatch):
    old = ModuleType("gsplat")
    old.__version__ = "0.1.12"
    monkeypatch.setitem(sys.modules, "gsplat", old)
    with pytest.raises(ImportError, match=r"0\.1\.12 is too old.*gsplat>=1\.4"), stand_in():
        pass
