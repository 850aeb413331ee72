"""AbsGS's density control against its rule, written as loops."""

import dataclasses
import math

import pytest
import torch
from strategies import begun, some, stepped

from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render.engine import engine_for
from reference_trainer.render.torch.engine import TorchEngine
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


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


def test_absgrad_counts_sums_of_absolute_values_of_what_was_rendered(tiny_scene):
    """Each of three steps against the two gradients computed from the splats alone; half are dropped."""
    config = TrainConfig(
        iterations=9, density="absgrad", dropout=0.5, densify_every=0, opacity_reset_every=0, loss="photometric(0.0)"
    )
    trainer = Trainer(tiny_scene, config)
    expected, counts = torch.zeros(150, dtype=torch.float64), torch.zeros(150)
    for _ in range(3):
        step = trainer.begin_steps()[0]
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
    torch.testing.assert_close(found.statistics.absolute_sum.double(), expected, rtol=1e-3, atol=1e-8)
    assert (found.statistics.absolute_sum >= found.statistics.gradient_sum * (1 - 1e-4)).all()
    assert (found.statistics.absolute_sum > 1.5 * found.statistics.gradient_sum).any()


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
        optimizer = stepped(dataclasses.replace(some(3), opacity_logits=torch.logit(torch.tensor([0.1, 0.7, 0.99]))))
        strategy.before_step(optimizer, step)
        if optimizer.gaussians.opacities.max() <= 0.6 + 1e-6:
            lowered.append(step)
    assert lowered == [4, 8]


def test_absolute_gradients_cost_nothing_unless_they_are_asked_for(tiny_scene, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("computed without need")

    monkeypatch.setattr(engine_for(torch.device("cpu")), "absolute_gradients", refuse)
    Trainer(tiny_scene, TrainConfig(iterations=1)).train()
    with pytest.raises(AssertionError, match="without need"):
        Trainer(tiny_scene, TrainConfig(iterations=1, density="absgrad")).train()


def test_absgrad_is_refused_where_there_are_no_absolute_gradients():
    with pytest.raises(ValueError, match=r"analytic .*absolute gradients"):
        check(TrainConfig(density="absgrad", dropout=0.2, analytic=True))
