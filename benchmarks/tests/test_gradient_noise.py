"""Noise of the gradient on a scene of five Gaussians, whose 32 masks can be enumerated."""

import dataclasses
import itertools
import json
import math

import pytest
import torch
from heard import hearing
from oracles import brute_force, random_scene
from PIL import Image

from benchmarks import gradient_noise as study_module
from benchmarks.gradient_noise import gradient_noise, gradient_noise_study
from benchmarks.gradient_noise_moments import (
    LOSSES,
    DrawMoments,
    GradientNoise,
    Moments,
    StepNoise,
)
from ca_reg.functional import Multiplier, draw_keep_mask
from reference_trainer.evaluation.results import write_json
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.model.rendering import render_moments_of
from reference_trainer.runs.folder import CHECKPOINT
from reference_trainer.runs.folder import CONFIG as RUN_CONFIG
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.studies.study import run_study
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import expected_photometric_loss, photometric_loss
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

N, DRAWS, RATE = 5, 32, 0.3
MASKS = list(itertools.product([False, True], repeat=N))
GROUPS = ["means", "log_scales", "quaternions", "opacity_logits", "sh"]
BACKGROUND = torch.tensor([0.9, 0.2, 0.4], dtype=torch.float64)
CONFIG = TrainConfig(dropout=RATE, seed=3)


@pytest.fixture(scope="module")
def scene() -> tuple[Gaussians, list[View]]:
    """Gaussians that no pixel sees an end of: the renderer's early stop is not part of the theory."""
    s = random_scene(N, 14, 11, seed=2, size=0.45)
    g = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=s.means,
        log_scales=s.scales.log(),
        quaternions=s.quaternions,
        opacity_logits=torch.logit(0.3 + 0.5 * s.opacities),
        sh_dc=((s.colors - 0.5) / SH_C0)[:, None],
        sh_rest=0.1 * torch.randn(N, 3, 3, generator=g, dtype=torch.float64),
    )
    moved = s.camera.world_to_camera.clone()
    moved[:3, 3] += torch.tensor([0.3, 0.2, 0.1])
    cameras = s.camera, dataclasses.replace(s.camera, world_to_camera=moved)
    photographs = torch.rand(2, 3, 11, 14, generator=g, dtype=torch.float64)
    return gaussians, [View(name, c, x) for name, c, x in zip("ab", cameras, photographs, strict=True)]


@pytest.fixture(scope="module")
def result(scene) -> GradientNoise:
    state = torch.get_rng_state()
    gaussians, views = scene
    found = gradient_noise(gaussians, BACKGROUND, CONFIG, views, sh_degree=1, draws=DRAWS)
    assert torch.equal(torch.get_rng_state(), state)
    assert not any(x.requires_grad for _, x in gaussians.named())
    return found


def oracle(gaussians, view, factors) -> dict[str, torch.Tensor]:
    """Gradients by loss, all groups in one vector, of the definitions with the opacities times factors (N,)."""
    x = gaussians.map(lambda t: t.clone().requires_grad_())
    directions = torch.nn.functional.normalize(x.means - view.camera.position, dim=1)
    basis = 0.4886025119029199 * directions[:, [1, 2, 0]] * torch.tensor([-1.0, 1, -1])
    colors = (0.5 + SH_C0 * x.sh_dc[:, 0] + (basis[:, :, None] * x.sh_rest).sum(1)).clamp(min=0)
    sums, alpha = brute_force(x.means, x.quaternions, x.scales, x.opacities * factors, colors, view.camera)
    image = sums + (1 - alpha) * BACKGROUND[:, None, None]
    losses = {"photometric": photometric_loss(image, view.image), "squared": ((image - view.image) ** 2).mean()}
    leaves = [t for _, t in x.named()]
    return {
        loss: torch.cat([g.flatten() for g in torch.autograd.grad(losses[loss], leaves, retain_graph=True)])
        for loss in LOSSES
    }


@pytest.fixture(scope="module")
def enumerated(scene) -> list[dict[str, torch.Tensor]]:
    """For each view and loss the gradients under every mask, shape (32, parameters)."""
    gaussians, views = scene
    out = []
    for view in views:
        rows = [oracle(gaussians, view, torch.tensor(mask).double()) for mask in MASKS]
        out.append({loss: torch.stack([row[loss] for row in rows]) for loss in LOSSES})
    return out


def chances() -> torch.Tensor:
    kept = torch.tensor(MASKS).sum(1)
    return (1 - RATE) ** kept.double() * RATE ** (N - kept).double()


def split(vectors) -> dict[str, torch.Tensor]:
    """Cut (..., parameters) into groups."""
    sizes = [3 * N, 3 * N, 4 * N, N, 12 * N]
    return {**dict(zip(GROUPS, vectors.split(sizes, dim=-1), strict=True)), "all": vectors}


def drawn(enumerated, index, loss) -> torch.Tensor:
    """The gradients under the masks that the study drew at a view, shape (draws, parameters)."""
    generator = stream(CONFIG.seed, index, "gradient noise")
    masks = [tuple(draw_keep_mask(N, RATE, generator=generator).tolist()) for _ in range(DRAWS)]
    return enumerated[index][loss][[MASKS.index(mask) for mask in masks]]


def test_the_analytic_gradient_of_the_squared_error_is_the_mean_over_all_masks(result, enumerated):
    for index, name in enumerate("ab"):
        expected = split(chances() @ enumerated[index]["squared"])
        draws = split(drawn(enumerated, index, "squared"))
        for group, mu in expected.items():
            found = result.views[name]["squared"][group]
            mean = draws[group].mean(0)
            assert found.analytic == pytest.approx((float(mu @ mu), float(mu @ mean)), rel=1e-9)
            distances = [float((draws[group][:k].mean(0) - mu).square().sum()) for k in (2, 4, 8, 16, 32)]
            assert found.distances == pytest.approx(distances, rel=1e-9)
            assert [k for k, _, _ in found.law()] == [2, 4, 8, 16, 32]


def test_both_gradients_of_the_photometric_loss_are_compared_with_the_draws(scene, result, enumerated):
    gaussians, views = scene
    for index, view in enumerate(views):
        leaves = gaussians.map(lambda x: x.clone().requires_grad_())
        (image, variance, *_), _ = render_moments_of(
            leaves, Multiplier.dropout(RATE), view.camera, BACKGROUND, sh_degree=1
        )
        loss = expected_photometric_loss(image, variance, view.image)
        analytic = torch.cat([x.flatten() for x in torch.autograd.grad(loss, [x for _, x in leaves.named()])])
        control = oracle(gaussians, view, torch.full((N,), 1 - RATE, dtype=torch.float64))["photometric"]
        means = split(drawn(enumerated, index, "photometric").mean(0))
        for group, mean in means.items():
            found, a, c = result.views[view.name]["photometric"][group], split(analytic)[group], split(control)[group]
            assert found.analytic == pytest.approx((float(a @ a), float(a @ mean)), rel=1e-8)
            assert found.control == pytest.approx((float(c @ c), float(c @ mean)), rel=1e-8)
            assert found.distances[-1] == pytest.approx(float((a - mean).square().sum()), rel=1e-8)


@pytest.mark.parametrize("loss", LOSSES)
def test_moments_are_those_of_the_gradients_under_the_masks_that_were_drawn(result, enumerated, loss):
    for index, name in enumerate("ab"):
        for group, gradients in split(drawn(enumerated, index, loss)).items():
            found = result.views[name][loss][group]
            mean, first, second = gradients.mean(0), gradients[::2].mean(0), gradients[1::2].mean(0)
            assert found.draws == DRAWS
            assert found.variance == pytest.approx(gradients.var(0).sum().item(), rel=1e-8)
            assert found.squared == pytest.approx(float(mean @ mean), rel=1e-8)
            halves = [float(first @ second), float(first @ first), float(second @ second)]
            assert found.halves == pytest.approx(halves, rel=1e-8)


@pytest.mark.parametrize("loss", LOSSES)
def test_variance_and_length_estimate_those_over_all_masks(result, enumerated, loss):
    for index, name in enumerate("ab"):
        for group, gradients in split(enumerated[index][loss]).items():
            found, p = result.views[name][loss][group], chances()
            mu = p @ gradients
            squares = (gradients - mu).square().sum(1)
            variance = p @ squares
            # Standard errors of both, of the variance to first order in 1 / K. The band is 5 of them: a normal
            # estimate leaves it once in 1.7 million, and one of the 48 of this test once in 36,000 at most.
            of_variance = ((p @ squares.square() - variance**2) / DRAWS).sqrt()
            along = p @ ((gradients - mu) @ mu).square()
            covariance = (p[:, None] * (gradients - mu)).T @ (gradients - mu)
            of_length = (4 * along / DRAWS + 2 * covariance.square().sum() / (DRAWS * (DRAWS - 1))).sqrt()
            assert abs(found.variance - variance) < 5 * of_variance
            assert abs(found.signal - mu @ mu) < 5 * of_length


@pytest.mark.parametrize("loss", LOSSES)
def test_variance_between_views_is_that_of_their_means_without_the_noise_in_them(result, enumerated, loss):
    for group in [*GROUPS, "all"]:
        draws = [split(drawn(enumerated, index, loss))[group] for index in range(2)]
        means = torch.stack([x.mean(0) for x in draws])
        masks = sum(x.var(0).sum().item() for x in draws) / 2
        found = result.steps[loss][group]
        assert found.masks == pytest.approx(masks, rel=1e-8)
        spread = means.var(0, correction=0).sum().item()
        assert found.views == pytest.approx(spread - masks / DRAWS / 2, rel=1e-7, abs=1e-12)
        assert found.signal == pytest.approx(means.mean(0).square().sum().item() - masks / DRAWS / 2, rel=1e-7)
        if loss == "squared":
            exact = torch.stack([split(chances() @ enumerated[index][loss])[group] for index in range(2)])
            assert found.analytic_views == pytest.approx(exact.var(0, correction=0).sum().item(), rel=1e-7)
            assert found.analytic_signal == pytest.approx(exact.mean(0).square().sum().item(), rel=1e-9)


def sequences(values, p):
    """All sequences of 4 draws of the given vectors, with their probabilities."""
    for picks in itertools.product(range(len(values)), repeat=4):
        yield math.prod(p[i] for i in picks), [values[i] for i in picks]


def moments_of(draws, analytic, control) -> Moments:
    running = DrawMoments({"x": analytic})
    for x in draws:
        running.add({"x": x})
    return running.result({"x": control})["x"]


def test_the_estimators_are_unbiased_over_all_sequences_of_draws():
    """Expectations over the 256 sequences of 4 draws from 4 masks: no chance is involved, the band is rounding."""
    g = torch.Generator().manual_seed(1)
    values = torch.randn(4, 6, generator=g, dtype=torch.float64)
    analytic, control = torch.randn(2, 6, generator=g, dtype=torch.float64)
    p = torch.tensor([0.49, 0.21, 0.21, 0.09], dtype=torch.float64)
    mu = p @ values
    variance = (p @ (values - mu).square()).sum().item()
    sums = torch.zeros(4, dtype=torch.float64)
    for chance, draws in sequences(values, p.tolist()):
        m = moments_of(draws, analytic, control)
        distances = [m.distance(what) for what in ("analytic", "control")]
        sums += chance * torch.tensor([m.variance, m.signal, *distances], dtype=torch.float64)
    expected = [variance, (mu @ mu).item(), *((x - mu).square().sum().item() for x in (analytic, control))]
    assert sums.tolist() == pytest.approx(expected, rel=1e-12)


def test_the_parts_of_the_variance_of_a_step_are_unbiased_over_all_sequences_of_draws():
    """Two views with two masks each: 16 x 16 pairs of sequences."""
    values = torch.randn(2, 2, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    p, zero = torch.tensor([0.7, 0.3], dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    measured = [
        [
            (chance, torch.stack(draws).mean(0), moments_of(draws, zero, zero))
            for chance, draws in sequences(x, p.tolist())
        ]
        for x in values
    ]
    sums = torch.zeros(3, dtype=torch.float64)
    for (chance, mean, a), (other, its_mean, b) in itertools.product(*measured):
        step = StepNoise.of([a, b], ((mean + its_mean) / 2).square().sum().item(), 0.0)
        sums += chance * other * torch.tensor([step.masks, step.views, step.signal], dtype=torch.float64)
    mu = torch.einsum("m,vmx->vx", p, values)
    masks = torch.einsum("m,vmx->vx", p, (values - mu[:, None]).square()).sum(1).mean()
    expected = [masks, mu.var(0, correction=0).sum(), mu.mean(0).square().sum()]
    assert sums.tolist() == pytest.approx([x.item() for x in expected], rel=1e-12)


def test_the_expectation_itself_reaches_the_ceiling():
    g = torch.Generator().manual_seed(3)
    mu = torch.randn(2000, generator=g, dtype=torch.float64)
    differences = []
    for _ in range(40):
        m = moments_of([mu + 2 * torch.randn(2000, generator=g, dtype=torch.float64) for _ in range(4)], mu, -mu)
        assert m.cosine("control") == pytest.approx(-m.cosine("analytic"))
        assert 0.6 < m.ceiling < 0.8
        differences.append(m.cosine("analytic") - m.ceiling)
    std, mean = torch.std_mean(torch.tensor(differences))
    assert abs(mean) < 4 * std / math.sqrt(40)  # left by chance once in 16,000


def test_derived_numbers_of_known_moments():
    m = Moments(4, 20.0, 30.0, (15.0, 25.0, 36.0), (25.0, 24.0), (100.0, 30.0), (9.0, 7.0))
    assert (m.signal, m.relative_noise) == (25.0, 0.8)
    assert m.ceiling == pytest.approx(math.sqrt(2 * 0.5 / 1.5))
    assert (m.length("analytic"), m.length("control")) == (0.0, 1.0)
    assert (m.error("analytic"), m.worth("analytic")) == (2 / 25, 10.0)
    assert m.law() == [(2, 0.6, pytest.approx(math.sqrt(10 / 25))), (4, math.sqrt(7 / 25), math.sqrt(5 / 25))]
    both = Moments.total([m, m])
    assert dataclasses.asdict(both)["halves"] == (30.0, 50.0, 72.0)
    assert (both.draws, both.relative_noise, both.distances) == (4, 0.8, (18.0, 14.0))
    lost = dataclasses.replace(m, squared=5.0, halves=(-1.0, 1.0, 1.0))
    assert all(map(math.isnan, (lost.relative_noise, lost.ceiling, lost.error("analytic"), lost.length("analytic"))))
    step = StepNoise(masks=6.0, views=2.0, signal=4.0, analytic_views=1.0, analytic_signal=2.0)
    assert step.share_of_masks == 0.75
    assert step.relative() == {"masks": 1.5, "views": 0.5, "sampled": 2.0, "analytic": 0.5}


def test_the_analytic_gradient_repeats_and_both_steps_are_timed(result):
    assert result.repeats
    for times in (result.sampled_seconds, result.analytic_seconds):
        assert [len(x) for x in times] == [study_module.ROUNDS] * 2
        assert min(map(min, times)) > 0
    sampled, analytic = result.seconds()
    assert min(map(min, result.analytic_seconds)) <= analytic <= max(map(max, result.analytic_seconds))
    assert min(map(min, result.sampled_seconds)) <= sampled <= max(map(max, result.sampled_seconds))


def test_a_result_survives_json(result):
    assert GradientNoise.from_dict(json.loads(json.dumps(dataclasses.asdict(result)))) == result


def test_masks_that_leave_nothing_have_a_gradient_of_zero(scene):
    gaussians, views = scene
    behind = dataclasses.replace(gaussians, means=gaussians.means - torch.tensor([0.0, 0.0, 99.0]))
    found = gradient_noise(behind, BACKGROUND, CONFIG, views, sh_degree=1, draws=4)
    m = found.views["a"]["photometric"]["all"]
    assert (m.variance, m.squared, m.analytic) == (0.0, 0.0, (0.0, 0.0))
    assert math.isnan(m.relative_noise)


@pytest.mark.parametrize(
    ("change", "draws", "message"),
    [
        ({}, 2, "power of two of at least 4, got 2"),
        ({}, 12, "power of two of at least 4, got 12"),
        ({"dropout": 0.0}, 4, "dropout .*between 0 and 1, got 0"),
        ({"noise": 0.1}, 4, "plain dropout"),
        ({"regularizer": "noise(0.1)"}, 4, "plain dropout"),
    ],
)
def test_settings_out_of_range_are_refused(scene, change, draws, message):
    gaussians, views = scene
    config = dataclasses.replace(CONFIG, **change)
    with pytest.raises(ValueError, match=message):
        gradient_noise(gaussians, BACKGROUND, config, views, sh_degree=1, draws=draws)


OPTIONS = SceneOptions("synthetic", views=2, downscale=8)


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    """Two views, and noise and inverted dropout, which the study leaves out."""
    config = TrainConfig(regularizer="dropout(0.4, compensate=True)", noise=0.3, seed=5)
    return Trainer(load_scene(OPTIONS, seed=5), config)


@pytest.fixture(scope="module")
def run(trainer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "mixed" / "seed_0"
    trainer.save(folder / CHECKPOINT)
    scene = dataclasses.asdict(OPTIONS)
    write_json(folder / RUN_CONFIG, {"scene": scene, "config": dataclasses.asdict(trainer.config)})
    return folder


@pytest.mark.slow
def test_a_study_measures_plain_dropout_at_the_training_views_of_a_run(trainer, run, monkeypatch):
    monkeypatch.setattr(study_module, "ROUNDS", 1)
    study = gradient_noise_study([run], draws=4, dropout=0.2)
    ((name, settings),) = study.cases.items()
    result = GradientNoise.from_dict(json.loads(json.dumps(study.measure(**settings))))
    plain = TrainConfig(dropout=0.2, seed=5)
    step = trainer.gaussians, trainer.background, plain, trainer.views[:1]
    alone = gradient_noise(*step, sh_degree=0, draws=4)
    assert name == "/".join(run.parts[-3:])
    first = trainer.views[0].name
    assert (result.views[first], list(result.views)) == (alone.views[first], [view.name for view in trainer.views])


def test_a_study_writes_its_results(run, result, tmp_path, monkeypatch):
    monkeypatch.setattr(study_module, "gradient_noise", lambda *args, **keywords: result)
    with hearing() as messages:
        (record,) = run_study(gradient_noise_study([run], draws=4), tmp_path).values()
    assert GradientNoise.from_dict(record) == result
    summary, pooled = record["summary"]["squared"]["sh"], Moments.total(result.over_views("squared", "sh"))
    assert (summary["relative_noise"], summary["worth_control"]) == (pooled.relative_noise, pooled.worth("control"))
    assert summary["share_of_masks"] == result.steps["squared"]["sh"].share_of_masks
    assert record["summary"]["seconds"]["ratio"] == result.seconds()[1] / result.seconds()[0]
    text = (tmp_path / "gradient_noise.md").read_text(encoding="utf-8")
    assert text == messages[-2]
    assert f"{result.steps['photometric']['opacity_logits'].share_of_masks:.1%} |" in text
    assert "agree bit by bit" in text
    with Image.open(tmp_path / "gradient_noise.png") as picture:
        assert picture.width > 300


def test_a_study_refuses_what_it_cannot_measure(run):
    with pytest.raises(ValueError, match="power of two"):
        gradient_noise_study([run], draws=5)
