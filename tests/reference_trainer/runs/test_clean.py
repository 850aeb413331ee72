import dataclasses

import pytest
import torch
from veils import veiled_at

from reference_trainer.evaluation.shares import blend_weights, guard, mean_shares, share_per_weight
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.runs import edit_ply
from reference_trainer.runs.edit_ply import clean_ply, refined
from reference_trainer.runs.folder import BAKED_PLY, PLY
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.options import OrbitOptions
from reference_trainer.scenes.virtual_cameras import unseen_views


def rows(means: torch.Tensor) -> list[tuple[float, ...]]:
    return [tuple(row) for row in means.tolist()]


@pytest.mark.slow
def test_those_that_co_adapt_most_for_what_they_contribute_go(run, options, tmp_path, said):
    model, scene = load_run_model(run[0])
    found = clean_ply(run[0] / PLY, options, tmp_path / "c.ply", fraction=0.3, refine=0, anyway=True)
    cleaned = load_ply(tmp_path / "c.ply")
    n = len(model.gaussians)
    values = share_per_weight(mean_shares(model, scene.train)[0], blend_weights(model, scene.train))
    left = set(rows(cleaned.gaussians.means))
    stay = torch.tensor([row in left for row in rows(model.gaussians.means)])
    assert len(cleaned.gaussians) == int(stay.sum()) == n - round(0.3 * n)
    assert values[~stay].min() >= values[stay].max()
    assert cleaned.regularizer == model.regularizer
    assert [of.gaussians for of in found.values()] == [n, int(stay.sum())]
    table = next(text for text in said if "| as it was |" in text)
    assert f"| {found['as it was'].mean('test', 'psnr'):.2f} |" in table


@pytest.mark.slow
def test_refining_closes_the_holes(run, options, tmp_path):
    found = clean_ply(run[0] / PLY, options, tmp_path / "c.ply", fraction=0.3, refine=20, anyway=True)
    holes, closed = found["taken out"], found["after 20 steps"]
    assert closed.gaussians == holes.gaussians == len(load_ply(tmp_path / "c.ply").gaussians)
    assert closed.mean("train", "psnr") > holes.mean("train", "psnr")


@pytest.mark.parametrize(
    ("scheduled", "at_the_end"),
    [
        ("dropout(ramp(0.0, 0.5, 0, 7_000))", "dropout(0.5)"),
        ("dropout(between(0.5, 10, 7_000))", "dropout(0.5)"),  # it ends with the training
        ("drop_sh(0.5)", "drop_sh(0.0)"),  # which stops at step 6,000
    ],
)
def test_refining_regularizes_as_the_training_ended(scheduled, at_the_end, run):
    """It began anew: a rate that rises was 0, and one that ends with the training what it had been at first."""
    model, scene = load_run_model(run[0])
    bands = torch.rand(len(model.gaussians), 15, 3, generator=torch.Generator().manual_seed(0))
    model = dataclasses.replace(model, step=7_000, gaussians=dataclasses.replace(model.gaussians, sh_rest=bands))
    found, expected = (
        refined(dataclasses.replace(model, regularizer=text), scene, 3) for text in (scheduled, at_the_end)
    )
    for name, x in found.gaussians.named():
        assert torch.equal(x, dict(expected.gaussians.named())[name]), name
    assert not torch.equal(found.gaussians.means, model.gaussians.means)


def test_without_a_scene_a_model_is_cleaned_as_large_as_it_was(run, tmp_path, said):
    gaussians = load_ply(run[0] / PLY).gaussians
    small = dataclasses.replace(gaussians, means=gaussians.means / 100, log_scales=gaussians.log_scales - 4.6)
    small = dataclasses.replace(small, opacity_logits=small.opacity_logits + 4)  # a score from everywhere
    save_ply(small, tmp_path / "small.ply")
    orbit = OrbitOptions(cameras=2, size=32)
    found = clean_ply(tmp_path / "small.ply", orbit, tmp_path / "c.ply")
    assert list(found) == ["as it was", "taken out"]
    assert any("close the holes" in text for text in said)
    assert "orbit exact CA (1e-3)" in said[-2]
    assert "PSNR" not in said[-2]
    clean_ply(tmp_path / "small.ply", orbit, tmp_path / "few.ply", fraction=0.9995)  # of which nothing has a score
    assert "| n/a |" in said[-2]
    means = load_ply(tmp_path / "c.ply").gaussians.means
    assert len(means) == len(small) - round(0.1 * len(small))
    assert torch.cdist(means.double(), small.means.double()).amin(1).max() < 1e-5 * small.means.abs().max()


def test_what_cannot_be_cleaned_is_refused(run, scaled, options, tmp_path):
    ply, out = run[0] / PLY, tmp_path / "c.ply"
    for wrong in ({"fraction": 0.0}, {"fraction": 1.0}, {"refine": -1}):
        with pytest.raises(ValueError, match="fraction must"):
            clean_ply(ply, options, out, **wrong)
    with pytest.raises(ValueError, match="of the test"):
        clean_ply(scaled[0] / BAKED_PLY, options, out)
    with pytest.raises(FileExistsError, match="exists already"):
        clean_ply(ply, options, ply)
    assert not out.exists()


def test_a_model_that_was_trained_with_dropout_is_refused(run, options, tmp_path):
    """There is little to remove, and what was measured became worse."""
    with pytest.raises(ValueError, match=r"dropout\(0\.2\).*worse .*--anyway"):
        clean_ply(run[0] / PLY, options, tmp_path / "c.ply")
    assert not (tmp_path / "c.ply").exists()


@pytest.mark.slow
def test_what_hangs_goes_and_nothing_else(run, options, tmp_path, said):
    """A model that the guard finds something in: opaque Gaussians close before cameras beside the training cameras."""
    model, scene = load_run_model(run[0])
    views = [view.camera for view in unseen_views(scene) if view.name.startswith(("beyond train_0", "beyond train_2"))]
    opaque, veil = veiled_at(views, model.gaussians)
    save_ply(opaque, tmp_path / "veiled.ply", regularizer="dropout(0.2)")
    found = clean_ply(tmp_path / "veiled.ply", options, tmp_path / "c.ply", hanging=True)
    assert list(found) == ["as it was", "taken out"]  # it leaves no holes to be closed
    left = load_ply(tmp_path / "c.ply").gaussians.means
    expected = guard(dataclasses.replace(model, gaussians=opaque), scene).keep
    assert not expected[-len(veil) :].all()
    assert expected[: -len(veil)].all()
    assert rows(left) == rows(opaque.means[expected])
    assert any("nobody took a photograph" in text for text in said)


def test_what_hangs_is_sought_only_where_it_can_be_found(run, options, tmp_path):
    out = tmp_path / "c.ply"
    with pytest.raises(ValueError, match="give --scene"):
        clean_ply(run[0] / PLY, OrbitOptions(cameras=2, size=32), out, hanging=True)
    save_ply(load_ply(run[0] / PLY).gaussians, tmp_path / "plain.ply")
    with pytest.raises(ValueError, match="need each other"):
        clean_ply(tmp_path / "plain.ply", options, out, hanging=True)
    assert not out.exists()


def test_a_worse_fit_is_said(run, options, tmp_path, said):
    found = clean_ply(run[0] / PLY, options, tmp_path / "c.ply", fraction=0.9, refine=0, anyway=True)
    before, after = (evaluation.mean("train", "psnr") for evaluation in found.values())
    assert after < before - 1
    assert any(f"{after:.2f} dB, for {before:.2f}" in text for text in said)


def test_a_model_of_another_scene_is_named_as_by_an_evaluation(run, options, tmp_path, said):
    """It is in the pictures, so only the photographs can tell."""
    right = load_ply(run[0] / PLY).gaussians
    negative = dataclasses.replace(right, sh_dc=-4 * right.sh_dc, opacity_logits=right.opacity_logits + 4)
    for name, gaussians in (("right", right), ("other", negative)):
        save_ply(gaussians, tmp_path / f"{name}.ply")
        clean_ply(tmp_path / f"{name}.ply", options, tmp_path / f"{name}_clean.ply", refine=0)
    (doubt,) = (text for text in said if "a picture of one color" in text)
    assert f"{tmp_path / 'other.ply'} is not in the frame" in doubt


def test_a_fit_that_looks_the_same_is_not_said_to_be_worse(run, options, tmp_path, said, monkeypatch):
    """The guard took 3 of 14,214: "fitted worse than before: 12.56 dB, for 12.56"."""
    measured = iter([12.561, 12.559])

    def evaluate(*arguments):
        value, found = next(measured), original(*arguments)
        return dataclasses.replace(found, views=[dataclasses.replace(view, psnr=value) for view in found.views])

    original = edit_ply.evaluate
    monkeypatch.setattr(edit_ply, "evaluate", evaluate)
    clean_ply(run[0] / PLY, options, tmp_path / "c.ply", fraction=0.1, refine=0, anyway=True)
    assert sum("12.56" in text for text in said) == 1  # the table
    assert not any("fitted worse" in text for text in said)
