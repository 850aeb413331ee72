import dataclasses
import math
import signal
from itertools import pairwise

import pytest
import torch

from reference_trainer.camera import Camera
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.scene import PointCloud, Scene, View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import adaptive
from reference_trainer.training.density.operations import reset_opacity
from reference_trainer.training.interruption import TrainingInterrupted, TrainingStoppedError
from reference_trainer.training.trainer import Trainer


def assert_identical(one: Trainer, other: Trainer) -> None:
    """Parameters, Adam's moments and counts, and the statistics of density control, bit for bit."""
    assert one.step == other.step
    left, right = one.optimizer.state_dict(), other.optimizer.state_dict()
    for name, x in left["gaussians"].items():
        assert torch.equal(x, right["gaussians"][name]), name
        for key, moment in left["moments"][name].items():
            assert torch.equal(moment, right["moments"][name][key]), (name, key)
    for name, x in one.density.state_dict().items():
        assert torch.equal(x, other.density.state_dict()[name]), name


def straight(scene: Scene, config: TrainConfig) -> tuple[Trainer, list[int]]:
    trainer, counts = Trainer(scene, config), []
    trainer.train(after_step=lambda t: counts.append(len(t.gaussians)))
    return trainer, counts


@pytest.fixture(scope="module")
def whole(tiny_scene: Scene, busy: TrainConfig) -> tuple[Trainer, list[int]]:
    return straight(tiny_scene, busy)


@pytest.fixture(scope="module")
def decaying(tiny_scene: Scene, busy: TrainConfig) -> Trainer:
    return straight(tiny_scene, dataclasses.replace(busy, iterations=13, opacity_decay=0.99, densify_from=2))[0]


# Continuing


@pytest.mark.parametrize("at", [0, 8, 9, 19])  # 8: density control is due; 19: a reset is due
def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(tiny_scene, busy, whole, tmp_path, at):
    trainer, counts = whole
    assert max(counts) > 150  # the schedule does grow and prune
    assert any(later < earlier for earlier, later in pairwise(counts))
    first = Trainer(tiny_scene, busy)
    first.train(until=at)
    first.save(tmp_path / "checkpoint.pt")
    second = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    assert_identical(first, second)
    second.train()
    assert second.step == busy.iterations
    assert_identical(trainer, second)


@pytest.mark.parametrize("at", [4, 8, 11])  # at 4 and 8 density control is due in the next step
def test_ctrl_c_waits_for_the_end_of_the_step(tiny_scene, decaying, tmp_path, monkeypatch, at):
    """A signal in the middle of a change of the model; what is saved continues to the identical result."""
    first = Trainer(tiny_scene, decaying.config)
    step = first.optimizer.step

    def interrupted_step() -> None:
        if first.step == at:
            signal.raise_signal(signal.SIGINT)
        step()

    monkeypatch.setattr(first.optimizer, "step", interrupted_step)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(TrainingInterrupted):
        first.train()
    assert signal.getsignal(signal.SIGINT) is handler
    assert first.step == at + 1
    first.save(tmp_path / "checkpoint.pt")
    second = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    second.train()
    assert_identical(decaying, second)


def test_a_second_ctrl_c_does_not_wait(tiny_scene, monkeypatch):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=3))

    def impatient() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(trainer.optimizer, "step", impatient)
    with pytest.raises(KeyboardInterrupt) as caught:
        trainer.train()
    assert not isinstance(caught.value, TrainingInterrupted)
    assert trainer.step == 0


@pytest.mark.parametrize(("steps", "said"), [(3, "step 4 .*means .*finite"), (4, "infinite by step 4")])
def test_gaussians_that_are_not_numbers_stop_before_anything_is_pruned(tiny_scene, steps, said):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=9, densify_from=1, densify_every=4))
    trainer.train(until=steps)
    with torch.no_grad():
        trainer.gaussians.means[5, 1] = math.nan
    with pytest.raises(TrainingStoppedError, match=said):
        trainer.train()
    assert len(trainer.gaussians) == 150


def test_checkpoints_of_another_scene_are_refused(tiny_scene, busy, tmp_path):
    path = tmp_path / "checkpoint.pt"
    Trainer(tiny_scene, busy).save(path)
    with pytest.raises(ValueError, match=r"checkpoint\.pt .*scene 'synthetic', .*'fern'"):
        Trainer.load(path, dataclasses.replace(tiny_scene, name="fern"))
    with pytest.raises(ValueError, match=r"checkpoint\.pt .*views .*train_2"):
        Trainer.load(path, dataclasses.replace(tiny_scene, train=tiny_scene.train[:2]))


# Learning


def test_training_fits_the_photographs(tiny_scene):
    def error(trainer: Trainer) -> float:
        total = 0.0
        for view in tiny_scene.train:
            image = render_gaussians(trainer.gaussians, view.camera, tiny_scene.background).image
            total += (image - view.image).square().mean().item()
        return total / len(tiny_scene.train)

    trainer = Trainer(tiny_scene, TrainConfig(iterations=60, densify_every=0))
    before = error(trainer)
    trainer.train()
    assert error(trainer) < before / 3  # 4.8 dB


def test_the_loss_of_a_step_is_that_of_the_view_it_renders(tiny_scene):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=3, loss="photometric(0.0)", sh_degree=0))
    images = [
        render_gaussians(trainer.gaussians, v.camera, tiny_scene.background).image.detach() for v in tiny_scene.train
    ]
    found = trainer.train_step(), trainer.mse
    pairs = [
        ((i - v.image).abs().mean().item(), (i.clamp(0, 1) - v.image).square().mean().item())
        for i, v in zip(images, tiny_scene.train, strict=True)
    ]
    assert found in [pytest.approx(pair, rel=1e-5) for pair in pairs]


def test_the_squared_error_of_photographs_of_one_exposure_is_that_of_what_was_taken(tiny_scene):
    """Divided, they reach over 1, up to which renders are clamped."""
    taken, exposure = tiny_scene.train[0], torch.tensor([0.5, 0.6, 0.7])
    divided = dataclasses.replace(taken, image=taken.image / exposure[:, None, None], exposure=exposure)
    trainer = Trainer(dataclasses.replace(tiny_scene, train=(divided,)), TrainConfig(iterations=1, sh_degree=0))
    with torch.no_grad():
        trainer.gaussians.sh_dc.add_(4)
    image = render_gaussians(trainer.gaussians, taken.camera, tiny_scene.background).image.detach()
    assert (image > 1).any()
    trainer.train()
    expected = ((image * exposure[:, None, None]).clamp(0, 1) - taken.image).square().mean().item()
    assert trainer.mse == pytest.approx(expected, rel=1e-4)


# Randomness


def test_draws_depend_on_seed_and_step_alone_and_leave_the_global_generator(tiny_scene, busy):
    def masks(config: TrainConfig, *, shake: bool) -> list[torch.Tensor]:
        trainer, kept = Trainer(tiny_scene, dataclasses.replace(config, densify_every=0, iterations=5)), []

        def after_step(t: Trainer) -> None:
            kept.append(t.regularizer.keep)
            if shake:  # what else the process draws has no say
                torch.rand(7)

        trainer.train(after_step=after_step)
        return kept

    state = torch.get_rng_state()
    quiet = masks(busy, shake=False)
    assert torch.equal(torch.get_rng_state(), state)
    noisy = masks(busy, shake=True)
    other = masks(dataclasses.replace(busy, seed=1), shake=False)
    for step in range(5):
        assert torch.equal(quiet[step], noisy[step])
        assert not torch.equal(quiet[step], other[step])
    assert len({tuple(mask.tolist()) for mask in quiet}) == 5


def test_a_run_repeats_bit_for_bit(tiny_scene, busy, whole):
    assert_identical(whole[0], straight(tiny_scene, busy)[0])


# What ends a run


def with_first_pixel(scene: Scene, value: float) -> Scene:
    image = scene.train[1].image.clone()
    image[0, 0, 0] = value
    train = (scene.train[0], dataclasses.replace(scene.train[1], image=image), scene.train[2])
    return dataclasses.replace(scene, train=train)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_before_it_does_harm(tiny_scene, value):
    trainer = Trainer(with_first_pixel(tiny_scene, value), TrainConfig(iterations=9))
    with pytest.raises(TrainingStoppedError, match=r"loss .*(nan|inf) at step [123]"):
        trainer.train()
    assert trainer.step < 3  # the view is met in the first epoch
    assert all(torch.isfinite(x).all() and x.grad is None for _, x in trainer.gaussians.named())


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"prune_opacity": 0.99}, "prune_opacity"),
        ({"prune_size": 1e-6, "prune_size_from": 0}, "prune_size"),
        ({"opacity_decay": 0.01}, "opacity_decay"),
    ],
)
def test_a_model_without_gaussians_stops(tiny_scene, settings, named):
    config = TrainConfig(iterations=9, densify_from=1, densify_every=2, **settings)
    trainer = Trainer(tiny_scene, config)
    with pytest.raises(TrainingStoppedError, match=f"pruned after step 2: .*{named}"):
        trainer.train()


def test_views_that_show_nothing_are_steps_without_a_move(tiny_scene):
    """Behind the camera, and in front of it but beside the picture."""
    for shift in (torch.tensor([0.0, 0.0, -100.0]), torch.tensor([500.0, 0.0, 0.0])):
        cloud = dataclasses.replace(tiny_scene.points, positions=tiny_scene.points.positions + shift)
        trainer = Trainer(dataclasses.replace(tiny_scene, points=cloud), TrainConfig(iterations=2))
        before = trainer.gaussians.means.detach().clone()
        trainer.train()
        assert trainer.step == 2
        assert torch.equal(trainer.gaussians.means, before)
        assert trainer.density.statistics.steps.sum() == 0


# Schedules


def test_bands_of_spherical_harmonics_come_one_by_one(tiny_scene):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=20, sh_degree=2, sh_every=3, densify_every=0))
    degrees, moved = [], []

    def after_step(t: Trainer) -> None:
        degrees.append(t.sh_degree)
        moved.append([bool((t.gaussians.sh_rest[:, a:b] != 0).any()) for a, b in ((0, 3), (3, 8))])

    trainer.train(until=9, after_step=after_step)
    assert degrees == [0, 0, 1, 1, 1, 2, 2, 2, 2]
    assert moved == [[False] * 2] * 2 + [[True, False]] * 3 + [[True, True]] * 4


def test_the_rate_of_the_means_falls_exponentially_in_units_of_the_extent(tiny_scene, monkeypatch):
    trainer, rates = Trainer(tiny_scene, TrainConfig(iterations=4, means_rate=1e-2, means_rate_final=1e-4)), []
    monkeypatch.setattr(trainer.optimizer, "set_means_rate", rates.append)
    trainer.train()
    expected = [tiny_scene.extent * 1e-2 * 10 ** (-2 * step / 4) for step in range(4)]
    assert rates == pytest.approx(expected)


def test_regularizers_wait_for_their_step(tiny_scene):
    config = TrainConfig(iterations=4, dropout=0.5, noise=0.3, regularize_from=2)
    trainer, seen = Trainer(tiny_scene, config), []
    trainer.train(after_step=lambda t: seen.append((t.regularized, t.regularizer.keep is not None)))
    assert seen == [(False, False)] * 2 + [(True, True)] * 2
    plain = Trainer(tiny_scene, dataclasses.replace(config, dropout=0.0, noise=0.0))
    plain.train(until=2)
    late = Trainer(tiny_scene, config)
    late.train(until=2)
    assert_identical(plain, late)


def control(monkeypatch, scene: Scene, config: TrainConfig, steps: int) -> dict[str, list[int]]:
    """Run with nothing but the calls of density control, and list the steps of each."""
    trainer = Trainer(scene, config)
    calls: dict[str, list[int]] = {name: [] for name in ("clone", "split", "prune", "reset_opacity", "decay_opacity")}

    def note(name: str) -> None:
        monkeypatch.setattr(adaptive, name, lambda *args, **keywords: calls[name].append(trainer.step))

    for name in calls:
        note(name)
    for trainer.step in range(steps):
        trainer.density.before_step(trainer.optimizer, trainer.step)
    return calls


def test_when_density_is_controlled(tiny_scene, monkeypatch):
    config = TrainConfig(
        iterations=40, densify_from=10, densify_every=5, densify_until=25, opacity_decay=0.9,
        opacity_reset_from=7, opacity_reset_every=9,
    )  # fmt: skip
    calls = control(monkeypatch, tiny_scene, config, 40)
    assert calls["clone"] == calls["split"] == calls["prune"] == [15, 20]  # densify_until ends it
    assert calls["reset_opacity"] == [7, 16]
    assert calls["decay_opacity"] == list(range(11, 40))


def test_when_density_is_left_alone(tiny_scene, monkeypatch):
    config = TrainConfig(iterations=40, densify_from=10, densify_every=0, opacity_reset_every=0)
    assert not any(control(monkeypatch, tiny_scene, config, 40).values())


def test_growth_ends_at_the_limit_but_pruning_goes_on(tiny_scene, monkeypatch):
    config = TrainConfig(iterations=40, densify_from=10, densify_every=5, max_gaussians=150, opacity_reset_every=0)
    calls = control(monkeypatch, tiny_scene, config, 40)
    assert calls["clone"] == calls["split"] == []
    assert calls["prune"] == [15, 20, 25, 30, 35]


def test_resets_reach_the_model(tiny_scene):
    trainer = Trainer(tiny_scene, TrainConfig(iterations=9, opacity_reset_from=3, opacity_reset=0.02))
    trainer.step = 3
    trainer.density.before_step(trainer.optimizer, trainer.step)
    expected = Trainer(tiny_scene, trainer.config)
    reset_opacity(expected.optimizer, 0.02)
    assert torch.equal(trainer.gaussians.opacity_logits, expected.gaussians.opacity_logits)
    assert trainer.gaussians.opacities.max().item() == pytest.approx(0.02)


def test_initial_gaussians():
    """Two points, one camera: the scale is their distance, the color theirs; the extent of one camera is 1."""
    view = View("a", Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16), torch.zeros(3, 16, 16))
    positions, colors = torch.tensor([[0.0, 0, 4], [0.0, 0.3, 4]]), torch.tensor([[1.0, 0, 0], [0, 0.5, 1]])
    scene = Scene("two", (view,), (), PointCloud(positions, colors, "hand"), torch.zeros(3))
    gaussians = Trainer(scene, TrainConfig(iterations=1, initial_opacity=0.25)).gaussians
    torch.testing.assert_close(gaussians.scales.detach(), torch.full((2, 3), 0.3))
    torch.testing.assert_close(gaussians.opacities.detach(), torch.tensor([0.25, 0.25]))
    torch.testing.assert_close(gaussians.sh_dc.detach()[:, 0] * math.sqrt(1 / (4 * math.pi)) + 0.5, colors)
