"""Co-adaptation as a loss, at training views and at virtual ones, against the enumeration of all masks."""

import dataclasses
from itertools import product

import pytest
import torch

from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.scene import PointCloud
from reference_trainer.scenes.virtual_cameras import VIRTUAL_VIEWS
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.step import Step
from reference_trainer.training.trainer import Trainer

WHERE = ["training", *VIRTUAL_VIEWS]
MASKS = torch.tensor(list(product([0.0, 1.0], repeat=6)), dtype=torch.float64)


@pytest.fixture
def made(tiny_scene, three_views):
    """Make a term of the loss that has seen the three views."""
    positions = torch.tensor([[0.0, 0.0, 3.0], [0.3, 0.1, 4.0], [-0.2, 0.1, 6.0]], dtype=torch.float64)
    scene = dataclasses.replace(tiny_scene, train=tuple(three_views), points=PointCloud(positions, positions, "hand"))

    def make(text):
        (term,) = LOSSES.make(text)
        term.begin(scene)
        return term

    return make


def enumerated(gaussians: Gaussians, camera, p: float) -> torch.Tensor:
    """The mean over pixels and colors of the variance over all 64 masks."""
    probability = (p + (1 - 2 * p) * MASKS).prod(1)
    black = torch.zeros(3, dtype=torch.float64)
    images = torch.stack(
        [render_gaussians(gaussians, camera, black, opacities=gaussians.opacities * mask).image for mask in MASKS]
    )
    mean = torch.einsum("k,kchw->chw", probability, images)
    return torch.einsum("k,kchw->chw", probability, (images - mean) ** 2).mean()


@pytest.mark.parametrize("where", WHERE)
def test_it_is_the_variance_over_all_masks_at_its_camera_with_its_gradient(made, six, take_step, where):
    term, names = made(f"co_adaptation(0.7, 0.3, {where!r}, every=5)"), ("opacity_logits", "sh_dc", "means")
    found = []
    for exact in (True, False):
        leaves = {name: getattr(six, name).clone().requires_grad_() for name in names}
        step = take_step(**leaves)
        camera = step.view.camera if where == "training" else term.draw(step.generator("co_adaptation"))
        loss = term(step) if exact else 5 * 0.7 * enumerated(step.gaussians, camera, 0.3)
        found.append((loss, *torch.autograd.grad(loss, list(leaves.values()))))
        assert len(step.observed) == 1, "density control sees the render of the step alone"
    assert found[1][0] > 1e-3
    for ours, expected in zip(*found, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("where", ["training", "arc"])
def test_gradients_are_those_of_differences(made, assert_gradients_of_differences, where):
    term = made(f"co_adaptation(50.0, where={where!r})")
    assert_gradients_of_differences(term, "means", "log_scales", "quaternions", "opacity_logits", "sh_dc")


@pytest.mark.parametrize("where", list(VIRTUAL_VIEWS))
def test_virtual_views_depend_on_seed_and_step_alone_and_are_new_each_time(made, take_step, where):
    term = made(f"co_adaptation(where={where!r})")
    steps = [dict(number=number, seed=seed) for number in (0, 1, 2) for seed in (0, 1)]
    values = [term(take_step(**each)).item() for each in steps]
    torch.rand(3)
    assert values == [term(take_step(**each)).item() for each in steps]
    assert len(set(values)) == len(values)


def test_it_counts_at_every_so_many_steps_by_that_factor(made, take_step):
    often, seldom = (
        made("co_adaptation(0.5, where='arc')"),
        made("co_adaptation(between(0.5, 4), where='arc', every=4)"),
    )
    assert [number for number in range(12) if seldom.acts(number)] == [4, 8]
    step = take_step(number=8)
    assert seldom(step).item() == pytest.approx(4 * often(step).item(), rel=1e-12)


def test_other_steps_render_and_draw_nothing_for_it(tiny_scene, monkeypatch):
    seen = []
    monkeypatch.setattr(Step, "moments", lambda self, *args: seen.append(self.number) or moments(self, *args))
    loss = "photometric + co_adaptation(between(1.0, 2), where='arc', every=3) + co_adaptation(0.0, where='line')"
    Trainer(tiny_scene, TrainConfig(iterations=8, loss=loss)).train()
    assert seen == [3, 6]


moments = Step.moments


def test_a_resumed_run_is_the_uninterrupted_one(tiny_scene, busy, tmp_path):
    config = dataclasses.replace(busy, iterations=14, loss="photometric + co_adaptation(3.0, where='arc', every=2)")
    whole = Trainer(tiny_scene, config)
    whole.train(until=9)
    whole.save(tmp_path / "checkpoint.pt")
    resumed = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    whole.train()
    resumed.train()
    for (name, x), (_, y) in zip(whole.gaussians.named(), resumed.gaussians.named(), strict=True):
        assert torch.equal(x, y), name


def test_analytic_training_takes_a_variance_of_its_own_at_virtual_views(tiny_scene, busy):
    """That of the step is of the training view, and of the draws of its regularizers."""
    plain = dataclasses.replace(busy, noise=0.0, loss="co_adaptation(3.0, 0.5, 'arc')")
    losses = [Trainer(tiny_scene, dataclasses.replace(plain, analytic=x)).train_step() for x in (False, True)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("co_adaptation(p=1.0)", r"in \[0, 1\)"),
        ("co_adaptation(where='nowhere')", "where .*training, box, line, arc, beyond, got 'nowhere'"),
        ("co_adaptation(every=0)", "every .*at least 1, got 0"),
        ("co_adaptation(every=2.5)", r"'co_adaptation\(every=2\.5\)': every .*integer, got float"),
    ],
)
def test_bad_arguments(text, message):
    with pytest.raises(ValueError, match=message):
        LOSSES.make(text)


def test_a_single_photograph_has_no_views_between(tiny_scene):
    (term,) = LOSSES.make("co_adaptation(where='arc')")
    with pytest.raises(ValueError, match=r"two .*cameras, .*'synthetic' has 1"):
        term.begin(dataclasses.replace(tiny_scene, train=tiny_scene.train[:1]))
