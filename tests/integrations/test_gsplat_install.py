"""Installing the gsplat adapter for a script that is not edited: what it replaces, restores and refuses."""

import inspect
import sys
from types import ModuleType

import pytest
import torch
from stand_ins.gsplat import activated, rasterization, rasterization_that_culls_nothing, rasterization_without_radii
from torch import nn

from ca_reg import GaussianDropout
from ca_reg.decay import OpacityDecay
from ca_reg.integrations._report import Skip
from ca_reg.integrations.gsplat import Installation, install
from ca_reg.schedules import LinearRamp, StartStop


@pytest.fixture
def fake_gsplat(monkeypatch):
    """A package gsplat with the two places of the function."""
    gsplat, rendering = ModuleType("gsplat"), ModuleType("gsplat.rendering")
    gsplat.rasterization = rendering.rasterization = rasterization
    gsplat.rasterization_2dgs = rendering.rasterization_2dgs = rasterization_that_culls_nothing
    rendering.rasterization_inria_wrapper = rasterization_without_radii
    gsplat.rendering = rendering
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setitem(sys.modules, "gsplat.rendering", rendering)
    return gsplat


def test_install_reaches_an_unedited_script_and_restores_exactly(fake_gsplat, params, cameras):
    script = "from gsplat.rendering import rasterization\nimport gsplat\nfound = [rasterization, gsplat.rasterization]"
    schedule = StartStop(0.5, start=2)
    dropout = GaussianDropout(schedule)
    with install(dropout) as installation:
        names = {}
        exec(script, names)
        for _ in range(3):
            names["rasterization"](**activated(params), **cameras)
            dropped = dropout.keep is not None
        assert (dropout.step, dropped) == (2, True)  # the calls are its steps
        assert names["found"] == [installation.rasterization] * 2
        assert inspect.signature(names["rasterization"]) == inspect.signature(rasterization)
        with pytest.raises(ValueError, match="dropped twice"):
            install(dropout)
    assert fake_gsplat.rasterization is fake_gsplat.rendering.rasterization is rasterization
    assert installation.tally.regularized == installation.rasterization.tally.regularized == 1
    assert installation.tally.skipped[Skip.RATE_ZERO] == 2
    installation.uninstall()
    assert fake_gsplat.rasterization is rasterization


def test_install_reaches_2dgs_and_refuses_what_returns_no_radii(fake_gsplat, params, cameras):
    dropout = GaussianDropout(0.5)
    with install(dropout) as installation:
        fake_gsplat.rasterization(**activated(params), **cameras)
        info = fake_gsplat.rendering.rasterization_2dgs(**activated(params), **cameras, packed=False)[2]
        assert not info["radii"][:, ~dropout.keep].any()
        assert dropout.step == 1  # one count for all functions
        with pytest.raises(RuntimeError, match=r"no radii, .*gsplat\.rasterization"):
            fake_gsplat.rendering.rasterization_inria_wrapper(**activated(params), **cameras)
    assert installation.tally.regularized == 3
    assert set(installation.functions) == {"rasterization", "rasterization_2dgs", "rasterization_inria_wrapper"}
    assert fake_gsplat.rasterization_2dgs is rasterization_that_culls_nothing


@pytest.mark.parametrize(("patience", "steps"), [(2, 9), (100, 2)])
def test_a_training_past_the_installation_is_an_error(fake_gsplat, params, cameras, patience, steps):
    kept = fake_gsplat.rasterization  # as a script that was imported first
    groups = [{"params": [x], "name": name} for name, x in params.items()]
    optimizers = [torch.optim.SGD([group], lr=0.1) for group in groups]  # one for each, as gsplat's trainers make them
    made = 0

    def train():
        nonlocal made
        for _ in range(steps):
            kept(**activated(params), **cameras)[0].sum().backward()
            for optimizer in optimizers:
                optimizer.step()
            made += 1

    with (
        pytest.raises(RuntimeError, match=r"regularized.* before install"),
        install(GaussianDropout(0.5), patience=patience),
    ):
        train()
    assert made == 2


def test_opacities_decay_after_their_own_optimizers_steps(fake_gsplat, params, cameras):
    before = {name: x.detach().clone() for name, x in params.items()}
    optimizers = [torch.optim.SGD([{"params": [x], "name": name}], lr=0.0) for name, x in params.items()]
    with install(GaussianDropout(0.5), decay=OpacityDecay(0.9, start=1)):
        for _ in range(3):
            fake_gsplat.rasterization(**activated(params), **cameras)[0].sum().backward()
            for optimizer in optimizers:
                optimizer.step()
    after = params["opacities"].detach().sigmoid()
    torch.testing.assert_close(after, 0.81 * before.pop("opacities").sigmoid(), rtol=1e-5, atol=0)
    assert all(torch.equal(params[name], x) for name, x in before.items())


def test_frozen_gaussians_neither_decay_nor_count_as_missed(fake_gsplat, params, cameras):
    optimizer = torch.optim.Adam([{"params": [params["opacities"]], "name": "opacities"}], lr=0.0)
    before = torch.sigmoid(params["opacities"].detach())
    with install(GaussianDropout(0.5), decay=OpacityDecay(0.9, start=0), patience=2):
        fake_gsplat.rasterization(**activated(params), **cameras)[0].sum().backward()
        optimizer.step()
        params.requires_grad_(False)
        for _ in range(4):
            fake_gsplat.rasterization(**activated(params), **cameras)
            optimizer.step()
    torch.testing.assert_close(torch.sigmoid(params["opacities"]), 0.9 * before)


@pytest.mark.parametrize(("steps", "factor"), [(0, 0.5), (1, 1.0), (2, 0.95)])  # of which the first has a rate of 0
def test_a_process_that_only_evaluates_is_past_its_schedule(fake_gsplat, params, cameras, steps, factor):
    seen = []
    installation = install(GaussianDropout(LinearRamp(0.0, 0.5, 0, 10)))
    for function in installation.functions.values():
        inner = function.rasterization
        function.rasterization = lambda *args, inner=inner, **named: seen.append(named["opacities"]) or inner(**named)
    for _ in range(steps):
        fake_gsplat.rasterization(**activated(params), **cameras)
    with torch.no_grad():
        fake_gsplat.rasterization(**activated(params), **cameras)
    installation.uninstall()
    torch.testing.assert_close(seen[-1], activated(params)["opacities"] * factor)


def test_a_model_in_evaluation_is_scaled_although_gradients_are_on(fake_gsplat, params, cameras):
    """As nerfstudio's, whose losses are evaluated so."""

    class Owner(nn.Module):
        def __init__(self):
            super().__init__()
            self.splats = params

        def forward(self):
            return fake_gsplat.rasterization(**activated(self.splats), **cameras)

    owner, renderer = Owner(), nn.Identity().eval()
    with install(GaussianDropout(0.5)) as installation:
        owner()
        owner.eval()()
        assert (installation.tally.regularized, installation.tally.scaled) == (1, 1)
        renderer.forward = lambda self: fake_gsplat.rasterization(**activated(params), **cameras)
        renderer.forward(renderer)  # a module in eval() whose parameters these are not
        assert (installation.tally.regularized, installation.tally.scaled) == (2, 1)


def test_a_block_installs_what_is_not(fake_gsplat):
    original = fake_gsplat.rasterization
    with Installation(GaussianDropout(0.5)) as installation:
        assert fake_gsplat.rasterization is installation.rasterization
    assert fake_gsplat.rasterization is original


def test_a_schedule_that_never_begins_is_an_error(fake_gsplat, params, cameras):
    optimizer = torch.optim.SGD([{"params": [params["opacities"]], "name": "opacities"}], lr=0.1)
    installation = install(GaussianDropout(StartStop(0.5, start=1000)))
    fake_gsplat.rasterization(**activated(params), **cameras)[0].sum().backward()
    optimizer.step()
    with pytest.raises(RuntimeError, match=r"not regularized\..*begin earlier"):
        installation.__exit__(None, None, None)


def test_the_package_is_replaced_and_restored():
    gsplat = pytest.importorskip("gsplat", exc_type=ImportError)
    names = ("rasterization", "rasterization_2dgs", "rasterization_inria_wrapper", "rasterization_2dgs_inria_wrapper")
    originals = {name: getattr(gsplat, name) for name in names}
    with install(GaussianDropout(0.2)) as installation:
        for name, original in originals.items():
            assert getattr(gsplat, name) is getattr(gsplat.rendering, name) is installation.functions[name]
            assert inspect.signature(getattr(gsplat, name)) == inspect.signature(original)
    for name, original in originals.items():
        assert getattr(gsplat, name) is getattr(gsplat.rendering, name) is original


def test_an_error_inside_restores_as_well(fake_gsplat):
    with pytest.raises(KeyError), install(GaussianDropout(0.2)):
        raise KeyError
    assert fake_gsplat.rasterization is rasterization


BEFORE = """
from gsplat.rendering import rasterization
colors, alphas, info = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height)
"""
AFTER = """
from gsplat.rendering import rasterization
from ca_reg import GaussianDropout
from ca_reg.integrations.gsplat import regularized
rasterization = regularized(rasterization, GaussianDropout(0.2))
colors, alphas, info = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height)
"""


def test_a_users_file_takes_three_added_lines(fake_gsplat, params, cameras):
    names = activated(params) | cameras
    exec(AFTER, names)
    assert names["rasterization"].tally.regularized == 1
    added = [line for line in AFTER.splitlines() if line not in BEFORE.splitlines()]
    assert len(added) <= 3
    assert [line for line in AFTER.splitlines() if line not in added] == BEFORE.splitlines()
