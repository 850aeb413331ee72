"""What prunes and what compares two models, against a literal implementation of its source's rule."""

import math

import numpy as np
import pytest
import torch

from ca_reg import CAScore
from reference_trainer.evaluation.shares import blend_weights
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

GEOMETRY = ("means", "log_scales", "quaternions", "opacity_logits")


def two(scene, density: str, **settings) -> Trainer:
    """A training of two models that has taken two steps and never densifies."""
    trainer = Trainer(scene, TrainConfig(iterations=40, density=density, models=2, densify_every=0, **settings))
    trainer.train(until=2)
    return trainer


def test_co_pruning_removes_what_has_no_counterpart(tiny_scene):
    trainer = two(tiny_scene, "co_pruning(0.4, every=5)", densify_from=5)
    g = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for model in trainer.models:
            model.gaussians.means.copy_(torch.randn(150, 3, generator=g))
    before = [model.gaussians.map(lambda x: x.detach().clone()) for model in trainer.models]
    counted = [model.density.statistics.steps.clone() for model in trainer.models]
    for step in (0, 4, 5, 6, 9):  # not due, or not after densify_from
        trainer.density.together(trainer.models, step)
    assert [len(model.gaussians) for model in trainer.models] == [150, 150]
    trainer.density.together(trainer.models, 10)
    for k, model in enumerate(trainer.models):
        own, other = (before[i].means.double().numpy() for i in (k, 1 - k))
        keep = np.array([min(math.dist(p, q) for q in other) < 0.4 for p in own])
        assert 20 < keep.sum() < 130
        for (name, x), (_, y) in zip(before[k].named(), model.gaussians.named(), strict=True):
            assert torch.equal(x[torch.from_numpy(keep)], y), name
        assert torch.equal(model.density.statistics.steps, counted[k][torch.from_numpy(keep)])


def test_a_model_that_would_be_empty_stops_the_training(tiny_scene):
    trainer = two(tiny_scene, "co_pruning(0.4, every=5)", densify_from=0)
    with torch.no_grad():
        trainer.models[1].gaussians.means.add_(100)
    with pytest.raises(TrainingStoppedError, match=r"within 0\.4 .*step 5: .*distance"):
        trainer.density.together(trainer.models, 5)


def literal_uncertain(pictures: np.ndarray, share: float, least: float) -> np.ndarray:
    """Pictures (3, V, 3, H, W) in float64: pixel by pixel."""
    deviation = pictures.std(0, ddof=1).mean(1)
    views, height, width = deviation.shape
    padded, found = np.pad(deviation, ((0, 0), (2, 2), (2, 2))), np.zeros(deviation.shape, bool)
    for v in range(views):
        boxes = [[padded[v, i : i + 5, j : j + 5].sum() / 25 for j in range(width)] for i in range(height)]
        largest = sorted(np.ravel(boxes), reverse=True)[int(share * height * width)]
        found[v] = np.array(boxes) > max(largest, least)
    return found


def literal_chosen(gaussians, cameras, uncertain: np.ndarray) -> np.ndarray:
    """Gaussian by Gaussian; radii from covariances that are projected here."""
    chosen = np.zeros(len(gaussians), bool)
    scales, means = gaussians.scales.double().numpy(), gaussians.means.double().numpy()
    for camera, where in zip(cameras, uncertain, strict=True):
        pose = camera.world_to_camera.double().numpy()
        limits = 1.3 * np.array([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
        for n, point in enumerate(means @ pose[:3, :3].T + pose[:3, 3]):
            x, y, z = point
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if z < 0.2 or not (0 <= u < camera.width and 0 <= v < camera.height):
                continue
            w, i, j, k = (q := gaussians.quaternions[n].double().numpy()) / np.linalg.norm(q)
            turn = np.array([
                [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
                [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
                [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
            ])  # fmt: skip
            root = pose[:3, :3] @ turn @ np.diag(scales[n])
            tx, ty = np.clip([x / z, y / z], -limits, limits) * z
            focal = np.array([camera.fx, camera.fy]) / z
            jacobian = np.column_stack([np.diag(focal), -focal * np.array([tx, ty]) / z])
            covariance = jacobian @ root @ root.T @ jacobian.T + 0.3 * np.eye(2)
            mid, det = np.trace(covariance) / 2, np.linalg.det(covariance)
            radius = math.ceil(3 * math.sqrt(mid + math.sqrt(max(0.1, mid * mid - det))))
            if any((u - column) ** 2 + (v - row) ** 2 < radius for row, column in np.argwhere(where)):
                chosen[n] = True
    return chosen


def test_self_ensembling_perturbs_the_second_model_where_the_first_changes(tiny_scene):
    trainer = two(tiny_scene, "self_ensembling(100.0, 5, start=10, stop=30, views=3, share=0.02)", seed=4)
    strategy, (first, second) = trainer.density, trainer.models
    g, pictures = torch.Generator().manual_seed(0), []
    for step in (3, 5, 10):  # steps 0 and 5 only look; those in between do nothing
        if step == 3:
            strategy.together(trainer.models, 0)
        with torch.no_grad():
            pictures.append(
                torch.stack(
                    [
                        render_gaussians(first.gaussians, camera, trainer.background, sh_degree=0).image
                        for camera in strategy.cameras
                    ]
                )
            )
        before = [model.gaussians.map(lambda x: x.detach().clone()) for model in trainer.models]
        moments = second.optimizer.state_dict()["moments"]
        strategy.together(trainer.models, step)
        if step < 10:
            assert all(
                torch.equal(x, y) for (_, x), (_, y) in zip(before[1].named(), second.gaussians.named(), strict=True)
            )
            with torch.no_grad():  # Gaussians of the first change color
                first.gaussians.sh_dc.add_(0.5 * torch.randn(first.gaussians.sh_dc.shape, generator=g))
    uncertain = literal_uncertain(torch.stack(pictures).double().numpy(), 0.02, 0.01)
    chosen = torch.from_numpy(literal_chosen(before[1], strategy.cameras, uncertain))
    assert 5 < int(chosen.sum()) < 140
    for (name, x), (_, y) in zip(before[1].named(), second.gaussians.named(), strict=True):
        changed = (x != y).flatten(1).any(1) if x.ndim > 1 else x != y
        assert torch.equal(changed, chosen & torch.tensor(name in GEOMETRY)), name
    assert all(torch.equal(x, y) for (_, x), (_, y) in zip(before[0].named(), first.gaussians.named(), strict=True))

    x = before[1].params(step=10)
    draw = strategy.noise.draw(x, stream(4, 10, "self_ensembling/0"))
    sums = {"means": draw.value[0], "opacity_logits": draw.value[1][:, 0], "log_scales": draw.value[2]}
    for name, noise in sums.items():
        expected = (getattr(before[1], name) + noise)[chosen]
        torch.testing.assert_close(getattr(second.gaussians, name).detach()[chosen], expected, rtol=1e-4, atol=1e-5)
    after = second.optimizer.state_dict()["moments"]
    for name, of in moments.items():
        for key, moment in of.items():
            cleared = name in GEOMETRY and key != "step"
            assert torch.equal(after[name][key], torch.zeros_like(moment) if cleared else moment), (name, key)


def test_self_ensembling_ends(tiny_scene):
    trainer = two(tiny_scene, "self_ensembling(100.0, 5, start=10, stop=30, views=1)")
    for step in (20, 25):
        trainer.density.together(trainer.models, step)
    before = trainer.density.images.clone(), trainer.models[1].gaussians.means.detach().clone()
    trainer.density.together(trainer.models, 30)
    assert torch.equal(trainer.density.images, before[0])
    assert torch.equal(trainer.models[1].gaussians.means, before[1])


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
    score, weights = CAScore.exact(model.moments, drop_rate=0.3), blend_weights(model, trainer.views)
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
