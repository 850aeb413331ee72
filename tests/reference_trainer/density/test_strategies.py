"""The strategies, each against a literal implementation of its source's rule, and what all of them must keep."""

import dataclasses
import math
from itertools import combinations

import numpy as np
import pytest
import torch
from devices import CARD, DEVICES
from scipy.spatial.transform import Rotation

from ca_reg import CAScore
from reference_trainer.camera import Camera
from reference_trainer.density import DENSITY, DensityStrategy, RayBoxDensity
from reference_trainer.density.mcmc import relocate
from reference_trainer.density.ray_boxes import ray_box
from reference_trainer.evaluation.shares import blend_weights
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import PARAMETERS, Gaussians, inverse_sigmoid
from reference_trainer.model.optimizer import GaussianOptimizer, LearningRates
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render.eager.engine import TorchEngine
from reference_trainer.render.engine import engine_for
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan
from reference_trainer.training.trainer import Trainer

ALL = {
    "adaptive": "adaptive",
    "absgrad": "absgrad(1e-5, 2e-5, 0.05, ceiling_every=7)",
    "proximity": "proximity(distance=0.001, split_distance=0.01)",
    "mcmc": "mcmc(growth=1.2)",
    "ray_boxes": "ray_boxes(height=5, width=8)",
    "share_pruning": "share_pruning(every=3, fraction=0.1)",
    "co_pruning": "co_pruning(0.5, every=3)",
    "self_ensembling": "self_ensembling(2.0, every=2, start=4, stop=13, views=2)",
}


def some(n: int, seed: int = 0, size: float = 0.1) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,)}
    tensors = {name: torch.randn(*shape, generator=g) for name, shape in shapes.items()}
    tensors["log_scales"] += math.log(size)
    colors = {"sh_dc": torch.randn(n, 1, 3, generator=g), "sh_rest": torch.randn(n, 3, 3, generator=g)}
    return Gaussians(**tensors, **colors)


def stepped(gaussians: Gaussians) -> GaussianOptimizer:
    """An optimizer whose moments are not zero."""
    optimizer = GaussianOptimizer(gaussians, LearningRates(means=1e-3))
    sum((x.square() * (1 + torch.arange(len(x)).view(-1, *[1] * (x.ndim - 1)))).sum() for _, x in
        optimizer.gaussians.named()).backward()  # fmt: skip
    optimizer.step()
    return optimizer


def begun(expression: str, scene, count: int, **settings) -> DensityStrategy:
    strategy = DENSITY.make_one(expression)
    strategy.begin(TrainConfig(**settings), scene, torch.device("cpu"), count)
    return strategy


def short(config: TrainConfig, expression: str, iterations: int) -> TrainConfig:
    """Settings with this density control, and as many fields as it compares."""
    fields = 2 if "fields" in DENSITY.make_one(expression).needs else 1
    return dataclasses.replace(config, density=expression, iterations=iterations, prune_size=None, fields=fields)


# All of them


def test_all_are_tested():
    assert set(ALL) == set(DENSITY)


@pytest.mark.parametrize("expression", ALL.values(), ids=ALL)
def test_a_resumed_training_is_identical(tiny_scene, busy, tmp_path, expression):
    config = short(busy, expression, 14)
    whole = Trainer(tiny_scene, config)
    whole.train()
    assert len(whole.gaussians) != 150  # or nothing would have happened
    for at in (6, 8):  # between two densifications, and where one is due
        part = Trainer(tiny_scene, config)
        part.train(until=at)
        part.save(tmp_path / "checkpoint.pt")
        again = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
        again.train()
        for one, other in zip(whole.fields, again.fields, strict=True):
            torch.testing.assert_close(other.state_dict(), one.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("device", [pytest.param(CARD, marks=pytest.mark.slow), DEVICES[2]], indirect=True)
@pytest.mark.parametrize("expression", ALL.values(), ids=ALL)
def test_all_work_on_a_device(tiny_scene, busy, expression, device):
    trainer = Trainer(tiny_scene, short(busy, expression, 10), device)
    trainer.train()
    assert len(trainer.gaussians) != 150
    assert all(bool(x.isfinite().all()) for _, x in trainer.gaussians.named())
    found = [*trainer.gaussians.named(), *trainer.density.state_dict().items()]
    assert {x.device.type for _, x in found} == {torch.device(device).type}


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("absgrad(0)", "clone_gradient must be positive"),
        ("absgrad(split_gradient=-1.0)", "split_gradient must be positive"),
        ("absgrad(dense_fraction=0)", "dense_fraction must be positive"),
        ("absgrad(opacity_ceiling=1.0)", "opacity_ceiling must be in"),
        ("absgrad(ceiling_every=-1)", "ceiling_every must not be negative"),
        ("proximity(until=-1)", "until must not be negative"),
        ("proximity(distance=0.0)", "distance and split_distance must be positive"),
        ("mcmc(noise=-1)", "noise must not be negative"),
        ("mcmc(growth=0.9)", "growth must be at least 1"),
        ("ray_boxes(views=1)", "views must be at least 2"),
        ("ray_boxes(height=0)", "height and width must be positive"),
        ("share_pruning(every=0)", "every must be at least 1"),
        ("share_pruning(fraction=1.0)", "fraction must be in"),
        ("share_pruning(drop_rate=0.0)", "drop_rate must be in"),
        ("co_pruning(0)", "distance must be positive"),
        ("co_pruning(every=0)", "every must be at least 1"),
        ("self_ensembling(first=0.0)", "above 0|positive"),
        ("self_ensembling(views=0)", "views >= 1"),
        ("self_ensembling(share=1.0)", "share in"),
        ("self_ensembling(least=-0.1)", "least >= 0"),
        ("co_pruning", "compares fields, of which there is one: set fields=2"),
    ],
)
def test_bad_arguments_are_refused(expression, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig(density=expression).check()


# AbsGS


def seen(strategy, signed: list[float], absolute: list[float], steps: int = 2) -> None:
    """Let a strategy have counted these means."""
    state = {"gradient_sum": torch.tensor(signed) * steps, "steps": torch.full((len(signed),), float(steps))}
    strategy.load_state_dict(state | {"absolute_sum": torch.tensor(absolute) * steps})


def test_absgrad_clones_by_the_signed_and_splits_by_the_absolute_gradient(tiny_scene):
    start = some(4)
    start.log_scales[:] = torch.tensor([0.01, 0.01, 0.5, 0.5]).log()[:, None] + math.log(tiny_scene.extent)
    optimizer = stepped(start)
    before = optimizer.gaussians.map(torch.Tensor.detach)
    strategy = begun("absgrad(2e-4, 4e-4, 0.1)", tiny_scene, 4, prune_opacity=0.0)
    # small and steep; small and torn; large and steep; large and torn
    seen(strategy, [2.1e-4, 1.9e-4, 2.1e-4, 1.9e-4], [3.9e-4, 4.1e-4, 3.9e-4, 4.1e-4])
    strategy.densify(optimizer, 500)
    new = optimizer.gaussians
    assert torch.equal(new.means[:4], before.means[[0, 1, 2, 0]])  # the last is the clone
    torch.testing.assert_close(new.scales[4:], before.scales[[3, 3]] / 1.6)
    assert len(new) == 6


def test_absgrad_counts_sums_of_absolute_values_of_what_was_drawn(tiny_scene):
    """Each of three steps against the two gradients computed from the splats alone; half are dropped."""
    config = TrainConfig(
        iterations=9, density="absgrad", dropout=0.5, densify_every=0, opacity_reset_every=0, loss="photometric(0.0)"
    )
    trainer = Trainer(tiny_scene, config)
    expected, counts = torch.zeros(150, dtype=torch.float64), torch.zeros(150)
    for _ in range(3):
        step = trainer._begin_steps()[0]
        drawn = step.regularizer.regularize(step.params, step.generator("regularizer"))
        with torch.no_grad():
            out = render_gaussians(drawn, step.view.camera, trainer.background, sh_degree=step.sh_degree)
        image = out.image - step.view.image
        of_image = image.sign() / image.numel()
        of_alpha = -(of_image * trainer.background[:, None, None]).sum(0)  # the light that is left shows the background
        upstream = torch.cat([of_image, torch.stack([torch.zeros_like(of_alpha), of_alpha])])
        sums = TorchEngine().absolute_gradients(out.splats, out.image, upstream)
        half = torch.tensor([step.view.camera.width / 2, step.view.camera.height / 2])
        expected[out.splats.indices] += (sums * half).norm(dim=1).double()
        counts[out.splats.indices[out.splats.lists.touched]] += 1
        trainer.train_step()
    found = trainer.density
    assert torch.equal(found.statistics.steps, counts)
    assert 0 < int((counts < 3).sum()) < 150
    torch.testing.assert_close(found.absolute_sum.double(), expected, rtol=1e-3, atol=1e-8)
    assert (found.absolute_sum >= found.statistics.gradient_sum * (1 - 1e-4)).all()
    assert (found.absolute_sum > 1.5 * found.statistics.gradient_sum).any()


def test_absgrad_lowers_opacities_at_its_steps_until_densification_ends(tiny_scene):
    strategy = begun(
        "absgrad(opacity_ceiling=0.6, ceiling_every=4)",
        tiny_scene,
        3,
        iterations=40,
        densify_until=9,
        densify_every=0,
        opacity_reset_every=0,
    )
    lowered = []
    for step in range(20):
        optimizer = stepped(
            dataclasses.replace(some(3), opacity_logits=inverse_sigmoid(torch.tensor([0.1, 0.7, 0.99])))
        )
        strategy.before_step(optimizer, step)
        if optimizer.gaussians.opacities.max() <= 0.6 + 1e-6:
            lowered.append(step)
    assert lowered == [4, 8]


def test_absolute_gradients_cost_nothing_unless_they_are_asked_for(tiny_scene, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("computed without need")

    monkeypatch.setattr(type(engine_for(torch.device("cpu"))), "absolute_gradients", refuse)
    Trainer(tiny_scene, TrainConfig(iterations=1)).train()
    with pytest.raises(AssertionError, match="without need"):
        Trainer(tiny_scene, TrainConfig(iterations=1, density="absgrad")).train()


def test_absgrad_is_refused_where_there_are_no_absolute_gradients():
    with pytest.raises(ValueError, match="analytic training has no absolute gradients"):
        TrainConfig(density="absgrad", dropout=0.2, analytic=True).check()


# FSGS


def test_proximity_unpools_and_splits_the_sparse(tiny_scene):
    """A far group of four large Gaussians: against the rule, written out with loops over all pairs."""
    scene = dataclasses.replace(tiny_scene)
    start = some(30, seed=3, size=0.01)
    start.means[26:] = torch.tensor([[60.0, 0, 0], [64, 0, 0], [60, 9, 0], [60, 0, 30]])
    start.log_scales[26:] = math.log(2 * scene.extent)
    start.log_scales[29] = math.log(0.5 * scene.extent)  # far, but small
    optimizer = stepped(start)
    old = optimizer.gaussians.map(torch.Tensor.detach)
    pairs = [[(a - b).square().sum().item() for b in old.means.double()] for a in old.means.double()]
    near = [sorted((d, j) for j, d in enumerate(row) if j != i)[:3] for i, row in enumerate(pairs)]
    mean = [sum(d for d, _ in three) / 3 for three in near]
    distance = 0.5 * min(mean[i] for i in (26, 27, 28)) / scene.extent
    strategy = begun(f"proximity(100, {distance}, 1e9)", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    strategy.densify(optimizer, 99)
    expected = [i for i in range(30) if mean[i] > distance * scene.extent and old.scales[i].max() > scene.extent]
    assert expected == [26, 27, 28]
    new = optimizer.gaussians
    assert len(new) == 30 + 9
    for row, (i, j) in enumerate((source, target) for source in expected for _, target in near[source]):
        torch.testing.assert_close(new.means[30 + row], (old.means[i] + old.means[j]) / 2)
        assert torch.equal(new.log_scales[30 + row], old.log_scales[j])
        assert torch.equal(new.opacity_logits[30 + row], old.opacity_logits[j])
    assert torch.equal(new.quaternions[30:], torch.tensor([[1.0, 0, 0, 0]]).expand(9, 4))
    assert not new.sh[30:].any()
    assert not any(m[30:].any() for m in optimizer.state_dict()["moments"]["means"].values() if m.ndim)

    optimizer = stepped(start)
    strategy.densify(optimizer, 100)  # unpooling is over
    assert len(optimizer.gaussians) == 30
    splits = begun(f"proximity(0, 1e9, {distance})", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    splits.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 33
    torch.testing.assert_close(optimizer.gaussians.scales[27:], old.scales[[26, 27, 28] * 2] / 1.6)


def test_proximity_looks_at_neighbors_only_if_there_are_three(tiny_scene):
    optimizer = stepped(some(3, size=100.0))
    strategy = begun("proximity(distance=1e-9)", tiny_scene, 3, prune_opacity=0.0)
    strategy.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 3


# MVGS


def closest(o1, d1, o2, d2):
    """The middle between two lines, by least squares for the two distances along them."""
    d1, d2 = d1 / np.linalg.norm(d1), d2 / np.linalg.norm(d2)
    (t, s), *_ = np.linalg.lstsq(np.stack([d1, -d2], 1), o2 - o1, rcond=None)
    return (o1 + t * d1 + o2 + s * d2) / 2


def boxes(views, images, height: int, width: int):
    """Lower and upper corners of the boxes of all pairs of views, pixel by pixel."""
    regions = []
    for view, image in zip(views, images, strict=True):
        error, worst = (image - view.image).abs().double().numpy(), (0.0, 0, 0)
        for i in range(0, error.shape[1] - height, height):
            for j in range(0, error.shape[2] - width, width):
                mean = error[:, i : i + height, j : j + width].mean()
                worst = max(worst, (mean, -i, -j))
        _, i, j = worst
        k = np.array([[view.camera.fx, 0, view.camera.cx], [0, view.camera.fy, view.camera.cy], [0, 0, 1]])
        rotation = view.camera.world_to_camera[:3, :3].double().numpy()
        rays = [
            rotation.T @ np.linalg.inv(k) @ np.array([x + 0.5, y + 0.5, 1.0])
            for y in (-i, height - i) for x in (-j, width - j)
        ]  # fmt: skip
        regions.append((view.camera.position.double().numpy(), rays))
    for (o1, rays1), (o2, rays2) in combinations(regions, 2):
        meets = np.stack([closest(o1, d1, o2, d2) for d1, d2 in zip(rays1, rays2, strict=True)])
        yield meets.min(0), meets.max(0)


@pytest.mark.parametrize("distance", [0.0, 10.0])
def test_ray_boxes_clones_inside_and_halves_the_threshold_of_cameras_far_apart(tiny_scene, distance):
    """Cameras around the origin of the world are far apart in the source's measure, those far from it are not."""
    shift = torch.tensor([0.0, 0.0, distance])
    away = torch.eye(4)
    away[:3, 3] = -shift
    views = tuple(
        dataclasses.replace(
            view, camera=dataclasses.replace(view.camera, world_to_camera=view.camera.world_to_camera @ away)
        )
        for view in tiny_scene.train
    )
    scene = dataclasses.replace(tiny_scene, train=views)
    start = some(1000, size=0.05)
    start.means[:] = 2 * start.means.tanh() + torch.tensor([0.0, 0.0, 3.0]) + shift
    optimizer = stepped(start)
    old = optimizer.gaussians.map(torch.Tensor.detach).map(torch.clone)
    small, large = int(old.scales.amax(1).argmin()), int(old.scales.amax(1).argmax())
    size = 0.999 * old.scales[large].max().item() / scene.extent
    strategy = begun("ray_boxes(height=10, width=15)", scene, 1000, dense_fraction=size, prune_opacity=0.0)
    seen_at = torch.zeros(1000)
    seen_at[[small, large]] = 3e-4  # of 5e-4, or half of it
    strategy.load_state_dict({"gradient_sum": seen_at, "steps": torch.ones(1000)})
    images = [render_gaussians(old, view.camera, scene.background, sh_degree=0).image for view in views]
    inside = torch.zeros(1000, dtype=torch.bool)
    for low, high in boxes(views, images, 10, 15):
        inside |= torch.from_numpy(((old.means.double().numpy() > low) & (old.means.double().numpy() < high)).all(1))
    assert 10 < inside.sum() < 900
    centers = [view.camera.position / view.camera.position.norm() for view in views]
    far = any((one - other).norm() > 1 for one, other in combinations(centers, 2))
    assert bool(far) is (distance == 0)
    strategy.densify(optimizer, 100)
    cloned = inside.clone()
    cloned[small] |= far
    new = optimizer.gaussians.means
    if far:  # the large one is split, and cloned as well if it is inside
        kept = torch.arange(1000) != large
        assert torch.equal(new[: 999 + cloned.sum()], torch.cat([old.means[kept], old.means[cloned]]))
        assert len(new) == 999 + cloned.sum() + 2
    else:
        assert torch.equal(new, torch.cat([old.means, old.means[cloned]]))


def test_ray_boxes_draws_views_that_depend_on_the_step_alone(tiny_scene, monkeypatch):
    drawn = []
    monkeypatch.setattr(RayBoxDensity, "_inside", lambda self, optimizer, views, step: drawn.append(views) or False)
    strategy = begun("ray_boxes(2)", tiny_scene, 4)
    for step in (*range(12), 3):
        strategy.grow(stepped(some(4)), step)
    names = [tuple(view.name for view in views) for views in drawn]
    assert names[3] == names[-1]
    assert all(len({*pair}) == 2 for pair in names)
    assert len({*names}) > 1


def test_ray_boxes_of_parallel_rays_are_none():
    camera = Camera(torch.eye(4), 10.0, 10.0, 4.0, 3.0, 8, 6)
    pose = torch.eye(4)
    pose[0, 3] = -1.0
    beside = dataclasses.replace(camera, world_to_camera=pose)
    corners = torch.tensor([[1.5, 1.5], [6.5, 4.5]])
    assert ray_box(camera, corners, beside, corners) is None


# 3DGS-MCMC


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
    logits = inverse_sigmoid(torch.cat([torch.tensor([0.1, 0.3, 0.6]), torch.full((40_000,), 1e-4)]))
    start = some(40_003)
    start.opacity_logits[:] = logits
    optimizer = GaussianOptimizer(start, LearningRates(means=1e-3))
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
    start.opacity_logits[:] = inverse_sigmoid(opacities)
    optimizer = GaussianOptimizer(start, LearningRates(means=1e-3))
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


# Shares of the exact score


def opaque(scene, density: str, **settings) -> Trainer:
    """A training whose views have a score: large Gaussians that let little through."""
    trainer = Trainer(scene, TrainConfig(iterations=9, density=density, opacity_reset_every=0, **settings))
    with torch.no_grad():
        trainer.gaussians.opacity_logits[:] = torch.linspace(1.0, 4.0, 150)
        trainer.gaussians.log_scales.add_(0.7)
    return trainer


def test_share_pruning_removes_the_highest_shares_per_weight(tiny_scene):
    """The shares add up to the scores of the training views at plain opacities, which are rendered another way."""
    trainer = opaque(tiny_scene, "share_pruning(5, 0.1, 0.3)", densify_from=1, densify_every=0, dropout=0.4)
    trainer.train(until=5)
    strategy, optimizer = trainer.density, trainer.optimizer
    values = strategy.shares_per_weight(optimizer, 5)
    model = TrainedModel(trainer.gaussians.map(torch.Tensor.detach), trainer.background, sh_degree=trainer.sh_degree)
    score, weights = CAScore(exact=model.moments, drop_rate=0.3), blend_weights(model, trainer.views)
    scores = [score(model.gaussians.opacities, view).value for view in trainer.views]
    assert min(scores) > 0
    assert (values[weights > 0] * weights[weights > 0]).sum().item() == pytest.approx(sum(scores), rel=1e-3)

    counted, means = strategy.statistics.steps.clone(), model.gaussians.means.clone()
    strategy.before_step(optimizer, 5)
    kept = torch.tensor([bool((optimizer.gaussians.means == mean).all(1).any()) for mean in means])
    assert int((~kept).sum()) == 15
    assert values[~kept].min() >= values[kept].max()
    assert torch.equal(strategy.statistics.steps, counted[kept])
    strategy.before_step(optimizer, 6)
    assert len(optimizer.gaussians) == 135


def test_share_pruning_keeps_those_without_a_share(tiny_scene):
    trainer = opaque(tiny_scene, "share_pruning(1, 0.9)", densify_from=0, densify_every=0)
    with torch.no_grad():
        trainer.gaussians.means[100:] += 1e3  # out of every view
    trainer.density.before_step(trainer.optimizer, 1)
    assert int((trainer.gaussians.means > 500).all(1).sum()) == 50
    assert len(trainer.gaussians) < 150
