import dataclasses
import json

import pytest
import torch
from reports import Parsed
from veils import veiled_at

from reference_trainer.cli import main
from reference_trainer.evaluation.pictures import is_own_png
from reference_trainer.evaluation.shares import guard, where_it_shows
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.report.page import write_report
from reference_trainer.runs.folder import GUARD, GUARD_PICTURE
from reference_trainer.runs.guarded import HANGING, keep_removed, log_what_hangs, removed_from
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes.virtual_cameras import unseen_views


@pytest.fixture(scope="module")
def veiled(run):
    """A model with opaque Gaussians close before a camera beyond the training cameras, and its scene."""
    model, scene = load_run_model(run[0])
    cameras = [view.camera for view in unseen_views(scene) if view.name.startswith("beyond train_0")]
    return dataclasses.replace(model, gaussians=veiled_at(cameras, model.gaussians)[0]), scene


@pytest.mark.slow
def test_it_is_shown_where_it_changes_the_picture_most(veiled):
    model, scene = veiled
    found = guard(model, scene)
    view, hung, freed = where_it_shows(model, scene, found)
    rest = dataclasses.replace(model, gaussians=model.gaussians[found.keep])
    changes = {}
    with torch.no_grad():
        for each in unseen_views(scene):
            images = [of.test_rendering(each).image.clamp(0, 1) for of in (model, rest)]
            changes[each.name] = max(changes.get(each.name, 0), (images[0] - images[1]).square().mean().item())
    assert view.name == max(found.where, key=lambda name: changes[name])
    assert (hung - freed).square().mean().item() == pytest.approx(changes[view.name])
    with pytest.raises(ValueError, match="nothing hangs"):
        where_it_shows(rest, scene, guard(rest, scene))


@pytest.mark.slow
def test_what_hangs_is_said_and_shown_beside_the_scores(veiled, tmp_path, said):
    model, scene = veiled
    log_what_hangs(model, scene, tmp_path)
    assert any("beyond train_0" in text for text in said)
    assert is_own_png(tmp_path / HANGING)
    freed = dataclasses.replace(model, gaussians=model.gaussians[guard(model, scene).keep])
    log_what_hangs(freed, scene, tmp_path)
    assert not (tmp_path / HANGING).exists()  # it would be of another model
    count = len(said)
    for other in (
        (dataclasses.replace(model, regularizer=""), scene),  # a plain model is not guarded
        (model, None),
        (model, dataclasses.replace(scene, train=scene.train[:1])),
    ):
        log_what_hangs(*other, tmp_path)
    assert len(said) == count


def test_somebody_elses_picture_stays(veiled, tmp_path):
    (tmp_path / HANGING).write_bytes(b"a picture of a fern")
    log_what_hangs(*veiled, tmp_path)
    assert (tmp_path / HANGING).read_bytes() == b"a picture of a fern"


def test_a_step_that_is_taken_again_is_told_once(veiled, tmp_path):
    model, scene = veiled
    found = guard(model, scene)
    for step in (2_000, 3_000, 2_000):
        keep_removed(tmp_path, step, model, scene, found)
    (line,) = removed_from(tmp_path)
    assert "after step 2,000" in line
    assert str(found) in line
    (tmp_path / GUARD).write_text("{}")
    with pytest.raises(ValueError, match="what the guard removed"):
        removed_from(tmp_path)


@pytest.mark.slow
def test_a_run_keeps_what_its_guard_removed_for_evaluation_and_report(veiled, options, short, tmp_path, capsys):
    """The guard acts after the last step, so that neither the model nor its checkpoint can tell."""
    model = veiled[0]
    save_ply(model.gaussians, tmp_path / "veiled.ply")
    settings = dataclasses.replace(
        short, iterations=1, noise=0.0, dropout=0.2, guard=1, densify_every=0, opacity_reset_every=0
    )
    out = tmp_path / "run"
    run_experiment(
        dataclasses.replace(options, init=str(tmp_path / "veiled.ply")), settings, out, monitoring=Monitoring(0)
    )
    (entry,) = json.loads((out / GUARD).read_text())
    assert entry["step"] == 1
    assert len(load_ply(out / "point_cloud.ply").gaussians) < len(model.gaussians)
    assert is_own_png(out / GUARD_PICTURE)
    main(["evaluate", str(out)])
    assert "after step 1: " in capsys.readouterr().out
    page = Parsed(write_report([out], views=1))
    assert any("after step 1: " in line for line in page.data["evidence"])
    assert page.data["veils"][0]["src"].startswith("data:image/")
