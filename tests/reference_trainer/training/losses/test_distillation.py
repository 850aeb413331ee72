"""What a model learns from others where nobody took a photograph, against renders made by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from ca_reg.regularizers import parse
from reference_trainer.evaluation.metrics import psnr, ssim
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.ply import save_ply
from reference_trainer.render import render
from reference_trainer.runs.run import load_run, run_experiment
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

DROPPED = "dropout(0.3)"


@pytest.fixture
def scene(tiny_scene, three_views):
    return dataclasses.replace(tiny_scene, train=tuple(three_views))


@pytest.fixture
def members(six, tmp_path):
    """Two models of other colors, trained with dropout: one with plain opacities, one with those of the test."""
    paths = [tmp_path / "plain.ply", tmp_path / "for viewers.ply"]
    of = [dataclasses.replace(six, sh_dc=six.sh_dc + more).map(torch.Tensor.float) for more in (1.0, 2.0)]
    save_ply(of[0], paths[0], regularizer=DROPPED)
    save_ply(of[1], paths[1], bake_p=0.3, regularizer=DROPPED)
    return [str(path) for path in paths], of


def by_hand(gaussians, camera, scale=1.0):
    """Return a model at a camera, with scaled opacities."""
    x = gaussians
    return render(x.means, x.quaternions, x.scales, scale * x.opacities, sh=x.sh, camera=camera).image.double()


def test_the_target_is_the_mean_of_all_members_as_they_are_shown(scene, six, take_step, members):
    paths, of = members
    (term,) = LOSSES.make(f"distillation({paths[0]!r}, {paths[1]!r}, weight=0.6, lambda_dssim=0.3)")
    term.begin(scene)
    found = term(take_step()).item()
    candidates = []
    for view in unseen_views(scene):
        own, target = by_hand(six, view.camera), sum(by_hand(x, view.camera, 0.7) for x in of) / 2
        error = np.abs(own.numpy() - target.clamp(0, 1).numpy()).mean()
        candidates.append(0.6 * (0.7 * error + 0.3 * (1 - ssim(own, target.clamp(0, 1)))))
    assert max(candidates) - min(candidates) > 1e-3  # a thousand times the difference allowed below
    assert min(abs(found - each) for each in candidates) < 1e-6


def test_every_step_looks_from_a_camera_of_its_own_with_a_draw_of_its_own(scene, take_step, members):
    (term,) = LOSSES.make(f"distillation({members[0][0]!r})")
    term.begin(scene)
    values = {number: term(take_step(number=number, regularizer=parse("dropout(0.5)"))).item() for number in range(8)}
    assert len(set(values.values())) > 4
    assert term(take_step(number=3, regularizer=parse("dropout(0.5)"))).item() == values[3]


def test_what_the_members_show_at_a_camera_is_rendered_once_for_all_backgrounds(scene, take_step, members, monkeypatch):
    def value(term, number, background):
        step = take_step(number=number)
        step.background = background
        return term(step).item()

    def new_term():
        (term,) = LOSSES.make(f"distillation({members[0][0]!r})")
        term.begin(scene)
        return term

    shown, rendered = TrainedModel.test_rendering, []
    monkeypatch.setattr(TrainedModel, "test_rendering", lambda *given: rendered.append(given) or shown(*given))
    term = new_term()
    red, green = torch.eye(3, dtype=torch.float64)[:2]
    values = [value(term, number, red) for number in range(40)]
    cameras = len(set(values))  # the model is the same at every step
    assert len(rendered) == cameras < 40
    assert values[:8] == [value(new_term(), number, red) for number in range(8)]
    over_green = value(term, 0, green)
    assert over_green == value(new_term(), 0, green) != values[0]


def test_a_model_as_bright_as_photographs_over_1_has_nothing_to_learn_from_itself(scene, six, take_step, tmp_path):
    """Photographs that were made equally bright reach over 1, and so do the models of them."""
    bright, path = dataclasses.replace(six, sh_dc=six.sh_dc + 4).map(torch.Tensor.float), tmp_path / "bright.ply"
    save_ply(bright, path)
    raw = {name: x.double() for name, x in bright.named()}
    assert take_step(**raw).image.max() > 1.1
    scene = dataclasses.replace(scene, train=tuple(dataclasses.replace(v, image=v.image / 0.4) for v in scene.train))
    (term,) = LOSSES.make(f"distillation({str(path)!r})")
    term.begin(scene)
    assert term(take_step(**raw)) < 1e-6


def test_density_control_does_not_see_it(scene, take_step, members):
    (term,) = LOSSES.make(f"distillation({members[0][0]!r})")
    term.begin(scene)
    step = take_step()
    before = [*step.observed]
    term(step)
    assert step.observed == before


def test_a_model_comes_to_show_what_its_teacher_shows(tiny_scene, tmp_path):
    """At cameras nobody took, after fifty steps of nothing else: the teacher's colors are half a unit off at first."""
    start = Trainer(tiny_scene, TrainConfig(iterations=1)).gaussians.map(torch.Tensor.detach)
    teacher, path = dataclasses.replace(start, sh_dc=start.sh_dc + 0.5), tmp_path / "teacher.ply"
    save_ply(teacher, path)
    config = TrainConfig(iterations=50, loss=f"distillation({str(path)!r})", densify_every=0, color_rate=0.05)
    trainer = Trainer(dataclasses.replace(tiny_scene, start=start), config)

    def likeness():
        views = unseen_views(tiny_scene)
        return min(psnr(by_hand(trainer.gaussians, v.camera).detach(), by_hand(teacher, v.camera)) for v in views)

    before = likeness()
    trainer.train()
    assert likeness() > before + 10


def test_a_resumed_distillation_is_identical(tiny_scene, tmp_path):
    path = tmp_path / "member.ply"
    save_ply(Trainer(tiny_scene, TrainConfig(iterations=1)).gaussians.map(torch.Tensor.detach), path)
    config = with_recipe("distilled", iterations=8, loss=f"photometric + distillation({str(path)!r})")
    whole, part = Trainer(tiny_scene, config), Trainer(tiny_scene, config)
    whole.train()
    part.train(until=3)
    part.save(tmp_path / "checkpoint.pt")
    again = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    again.train()
    assert all(x.equal(y) for (_, x), (_, y) in zip(whole.gaussians.named(), again.gaussians.named(), strict=True))


def test_a_model_learns_on_a_card_what_it_learns_on_the_processor(card, tmp_path):
    """Members, cameras and targets go where the model is."""
    scene = synthetic_scene(width=20, height=15, points=30)
    start = Trainer(scene, TrainConfig(iterations=1)).gaussians.map(torch.Tensor.detach)
    save_ply(start, path := tmp_path / "member.ply")
    start = dataclasses.replace(start, sh_dc=start.sh_dc + 0.5)
    config = with_recipe("distilled", iterations=2, dropout=0.0, loss=f"distillation({str(path)!r})")
    losses = []
    for device in ("cpu", card):
        trainer = Trainer(dataclasses.replace(scene, start=start), config, device)
        losses.append([trainer.train_step() for _ in range(2)])
    assert all(one > 0.01 for one in losses[0])
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)


def test_a_finished_run_is_measured_without_its_members(options, short, run, tmp_path):
    ply = tmp_path / "member.ply"
    ply.write_bytes((run[0] / "point_cloud.ply").read_bytes())
    config = dataclasses.replace(short, loss=f"photometric + distillation({str(ply)!r})")
    run_experiment(options, config, tmp_path / "run")
    ply.unlink()
    assert load_run(tmp_path / "run").step == short.iterations
    assert run_experiment(options, config, tmp_path / "run")["gaussians"] > 0


def test_members_are_named_that_cannot_be_shown(scene, take_step, members, six, tmp_path):
    (term,) = LOSSES.make("distillation")
    with pytest.raises(ValueError, match=r"\.ply"):
        term.begin(scene)
    ply = tmp_path / "own.ply"
    save_ply(six.map(torch.Tensor.float), ply, regularizer="my_module:MyDropout(0.3)")
    (term,) = LOSSES.make(f"distillation({str(ply)!r})")
    term.begin(scene)
    with pytest.raises(ValueError, match=r"own\.ply"):
        term(take_step())
    save_ply(six.map(torch.Tensor.float), ply, bake_p=0.3, regularizer="my_module:MyDropout(0.3)")
    assert term(take_step()) > 0
