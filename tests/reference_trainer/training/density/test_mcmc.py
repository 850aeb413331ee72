"""3DGS-MCMC's density control against its rule and its source's formulas."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from strategies import begun, some, stepped

from reference_trainer.model.gaussians import PARAMETERS
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density.mcmc import relocate
from reference_trainer.training.plan import make_plan


def test_mcmc_relocates_the_dead_to_the_living():
    start = some(40, seed=1)
    start.opacity_logits[:10] = -8.0
    start.opacity_logits[16:] -= 3.0
    optimizer = stepped(start)
    old, moments = optimizer.gaussians.map(torch.Tensor.detach).map(torch.clone), optimizer.state_dict()["moments"]
    dead = old.opacities <= 0.005
    assert bool(dead[:10].all())
    with torch.no_grad():
        relocate(optimizer, dead, torch.Generator().manual_seed(0))
    new, after = optimizer.gaussians, optimizer.state_dict()["moments"]
    source = [int((old.means == mean).all(1).nonzero()) for mean in new.means[dead].detach()]
    assert not dead[source].any()
    assert len(set(source)) < len(source)  # somebody was drawn twice
    place = dict(zip(dead.nonzero().squeeze(1).tolist(), source, strict=True))
    for i in range(40):
        if i in source or i in place:
            s = place.get(i, i)
            n, o = 1 + source.count(s), old.opacities[s].double().item()
            each = 1 - (1 - o) ** (1 / n)
            total = sum(
                math.comb(m - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1)
                for m in range(1, n + 1)
                for k in range(m)
            )
            assert new.opacities[i].item() == pytest.approx(max(each, 0.005), rel=1e-4)
            torch.testing.assert_close(new.scales[i], old.scales[s] * (o / total), rtol=1e-4, atol=0)
            for name in ("means", "quaternions", "sh_dc", "sh_rest"):
                assert torch.equal(getattr(new, name)[i], getattr(old, name)[s])
        else:
            assert all(torch.equal(dict(new.named())[name][i], dict(old.named())[name][i]) for name in PARAMETERS)
        for name in PARAMETERS:  # cleared for those that were drawn, left for the others, as in the source
            expected = 0 * moments[name]["exp_avg"][i] if i in source else moments[name]["exp_avg"][i]
            assert torch.equal(after[name]["exp_avg"][i], expected)


def test_mcmc_draws_by_opacity():
    """40,000 draws from three Gaussians. Each frequency within 5 standard deviations: false alarms below 2e-6."""
    logits = torch.logit(torch.cat([torch.tensor([0.1, 0.3, 0.6]), torch.full((40_000,), 1e-4)]))
    start = some(40_003)
    start.opacity_logits[:] = logits
    optimizer = GaussianOptimizer(start, dict.fromkeys(PARAMETERS, 1e-3))
    with torch.no_grad():
        relocate(optimizer, optimizer.gaussians.opacities <= 0.005, torch.Generator().manual_seed(0))
    for i, p in enumerate((0.1, 0.3, 0.6)):
        count = int((optimizer.gaussians.means[3:, 0] == start.means[i, 0]).sum())
        assert abs(count - 40_000 * p) < 5 * math.sqrt(40_000 * p * (1 - p))


def test_mcmc_grows_to_its_limit_and_a_place_keeps_its_opacity(tiny_scene):
    settings = {"iterations": 99, "densify_from": 1, "densify_every": 2}
    for limit, count in ((None, 110), (105, 105), (90, 100)):
        strategy = begun("mcmc(noise=0, growth=1.1)", tiny_scene, 100, max_gaussians=limit, **settings)
        start = some(100)
        start.opacity_logits.clamp_(min=-2.0)
        optimizer = stepped(start)
        old = optimizer.gaussians.map(torch.Tensor.detach).map(torch.clone)
        strategy.before_step(optimizer, 2)
        new = optimizer.gaussians
        assert len(new) == count
        for i in range(100):  # whoever sits at one place lets through what one did
            there = (new.means == old.means[i]).all(1)
            torch.testing.assert_close((1 - new.opacities[there]).prod(), 1 - old.opacities[i], rtol=1e-4, atol=1e-6)


def test_mcmc_noise_is_that_of_the_source(tiny_scene):
    """20,000 Gaussians of one shape: the covariance of their moves is Sigma^2 times the squared factor.

    Whitened, an entry of the sample covariance has standard deviation 0.01 on the diagonal, less beside it; the bounds
    are 5 of them, for 9 entries twice: false alarms below 2e-5. The seed is fixed.
    """
    n, quaternion, scales = 20_000, [0.9, -0.3, 0.2, 0.4], [0.07, 0.02, 0.15]
    opacities = torch.tensor([0.002, 0.02]).repeat_interleave(n)
    start = some(2 * n)
    start.quaternions[:], start.log_scales[:] = torch.tensor(quaternion), torch.tensor(scales).log()
    start.opacity_logits[:] = torch.logit(opacities)
    optimizer = GaussianOptimizer(start, dict.fromkeys(PARAMETERS, 1e-3))
    strategy = begun("mcmc", tiny_scene, 2 * n, iterations=100, densify_every=0)
    strategy.before_step(optimizer, 0)
    assert torch.equal(optimizer.gaussians.means, start.means)  # no step was taken
    strategy.before_step(optimizer, 31)
    moves = (optimizer.gaussians.means - start.means).detach().double()
    turn = torch.from_numpy(Rotation.from_quat([*quaternion[1:], quaternion[0]]).as_matrix())
    sigma = turn @ torch.tensor(scales).double().square().diag() @ turn.T
    rate = 1.6e-4 * (1.6e-6 / 1.6e-4) ** (30 / 100) * tiny_scene.extent
    for part, o in ((moves[:n], 0.002), (moves[n:], 0.02)):
        factor = 5e5 * rate / (1 + math.exp(-100 * ((1 - o) - 0.995)))
        white = torch.linalg.solve(sigma * factor, part.T).T
        assert (white.T @ white / n - torch.eye(3).double()).abs().max() < 5 * math.sqrt(2 / n)


def test_mcmc_resets_nothing_and_the_plan_says_so(tiny_scene):
    for density, decision in (("adaptive", "used"), ("mcmc", "left out")):
        items = make_plan(tiny_scene, TrainConfig(density=density)).items
        assert next(item for item in items if item.name == "opacity reset").decision == decision
