"""A PLY on a scene and on an orbit: what it says of itself, scales, frames, and what is written."""

import dataclasses
import json
import re
from contextlib import contextmanager

import pytest
import torch
from heard import hearing
from PIL import Image

from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import ResultStore
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import save_ply
from reference_trainer.runs.folder import BAKED_PLY, PLY
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.ply import load_for_views, load_ply_model, log_other_center, score_ply
from reference_trainer.runs.run import save_for_viewers
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import OrbitOptions

FEW = OrbitOptions(cameras=2, size=40)


def ball(n=300, radius=1.0, degree=0, opacity=0.9):
    """Colored Gaussians on a sphere."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1) * radius
    colors = torch.rand(n, 3, generator=generator)
    return Gaussians.from_points(points, colors, torch.full((n,), 0.15 * radius), sh_degree=degree, opacity=opacity)


def orbit(gaussians, tmp_path, name, **keywords):
    """Save and score; returns the scores and what was said."""
    save_ply(gaussians, tmp_path / f"{name}.ply")
    with hearing() as said:
        result = score_ply(tmp_path / f"{name}.ply", FEW, tmp_path / name, **keywords)
    return result, said


@contextmanager
def interrupted(monkeypatch):
    """A context in which Ctrl-C comes after the second view is measured, and before it is recorded."""
    original, done = ResultStore.add, []

    def add(store, name, record):
        if done:
            raise KeyboardInterrupt
        done.append(name)
        original(store, name, record)

    with monkeypatch.context() as patch:
        patch.setattr(ResultStore, "add", add)
        yield


def test_a_baked_ply_is_not_scaled_twice(run, options):
    """Three ways to the image of the test: baked and marked, plain with the rate, and the checkpoint."""
    out, _ = run
    scene = load_scene(options)
    baked, facts = load_ply_model(out / BAKED_PLY, background=scene.background)  # it says its rate itself
    plain, _ = load_ply_model(out / PLY, background=scene.background, regularizer="dropout(0.2)")
    trained, _ = load_run_model(out)
    assert (facts.opacity_scale, facts.for_rendering) == (0.8, False)
    assert re.search(r"0\.8 baked in, .*trained with: dropout\(0\.2\)", str(facts))
    assert baked.factor == plain.factor == trained.factor == 0.8
    torch.testing.assert_close(baked.gaussians.opacities, trained.gaussians.opacities, rtol=0, atol=2e-6)
    with pytest.raises(ValueError, match=r"dropout 0\.2, not .*dropout\(0\.5\)"):
        load_ply_model(out / BAKED_PLY, background=scene.background, regularizer="dropout(0.5)")
    for view in scene.test:
        images = [model.render(model.test_opacities, view)[0] for model in (baked, plain, trained)]
        torch.testing.assert_close(images[0], images[2], rtol=0, atol=1e-5)
        assert torch.equal(images[1], images[2])
        unscaled = trained.render(trained.gaussians.opacities, view)[0]
        assert (unscaled - images[2]).abs().max() > 1e-3


def test_a_ply_without_dropout_is_used_as_it_is(tmp_path, run):
    model = load_run_model(run[0])[0]
    save_ply(model.gaussians, tmp_path / "model.ply")
    assert load_ply_model(tmp_path / "model.ply", background=torch.zeros(3))[0].regularizer == ""


@pytest.mark.slow
def test_a_ply_with_the_mean_of_the_noise_is_used_as_it_is(run, scaled, options, tmp_path):
    out, results = scaled
    scene = load_scene(options)
    model, facts = load_ply_model(out / BAKED_PLY, background=scene.background)
    assert "used as they are" in str(facts)
    trained = load_run_model(out)[0]
    torch.testing.assert_close(model.test_opacities, trained.test_opacities, rtol=0, atol=1e-6)
    assert model.ca_score().settings == trained.ca_score().settings
    for view, scores in zip(scene.test, results["views"][3:], strict=True):
        image = model.render(model.test_opacities, view)[0].clamp(0, 1)
        assert psnr(image, view.image) == pytest.approx(scores["psnr"], abs=1e-3)
    save_for_viewers(load_run_model(run[0])[0], tmp_path / "dropout.ply")
    assert (tmp_path / "dropout.ply").read_bytes() == (run[0] / BAKED_PLY).read_bytes()


@pytest.mark.parametrize(("band", "used"), [(None, 0), (1, 1), (2, 2)])
def test_the_bands_that_are_used(tmp_path, band, used):
    gaussians = ball(n=4, degree=2)
    if band is not None:
        gaussians.sh_rest[3, {1: 2, 2: 3}[band], 0] = 0.1  # the last coefficient of band 1, the first of band 2
    save_ply(gaussians, tmp_path / "a.ply", pad_to_degree=3)
    facts = load_ply_model(tmp_path / "a.ply", background=torch.zeros(3))[1]
    assert (facts.gaussians, facts.sh_degree, facts.sh_degree_used) == (4, 3, used)
    assert f"SH degree 3 (bands above {used} " in str(facts)
    assert "opacities: plain" in str(facts)


def test_what_the_caller_says_comes_first(tmp_path):
    save_ply(ball(), tmp_path / "a.ply", regularizer="dropout(0.2)", step=5)
    model, facts = load_ply_model(tmp_path / "a.ply", background=torch.zeros(3))
    assert (facts.regularizer, model.dropout, model.step) == ("dropout(0.2)", pytest.approx(0.2), 5)
    model, _ = load_ply_model(tmp_path / "a.ply", background=torch.zeros(3), regularizer="dropout(0.5)")
    assert model.dropout == 0.5
    save_ply(ball(), tmp_path / "b.ply", regularizer="dropout(1.5)")
    with pytest.raises(ValueError, match=r"b\.ply .*: .*p must .*--regularizer"):
        load_ply_model(tmp_path / "b.ply", background=torch.zeros(3))


def test_a_baked_rate_of_many_digits_is_read_as_it_is(tmp_path):
    save_ply(ball(), tmp_path / "a.ply", bake_p=0.1234567)
    model, facts = load_ply_model(tmp_path / "a.ply", background=torch.zeros(3))
    assert facts.regularizer == "dropout(0.1234567)"
    torch.testing.assert_close(model.gaussians.opacities, ball().opacities)


def test_a_file_without_gaussians(tmp_path):
    save_ply(ball()[torch.zeros(300, dtype=torch.bool)], tmp_path / "none.ply")
    with pytest.raises(ValueError, match="holds no Gaussian"):
        score_ply(tmp_path / "none.ply", FEW, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_written_for_an_orbit(tmp_path):
    result, said = orbit(ball(), tmp_path, "ball", regularizer="dropout(0.2)", samples=3, seed=4)
    data = json.loads((tmp_path / "ball" / "evaluation.json").read_text())
    assert data["ply"] == {"gaussians": 300, "sh_degree": 0, "sh_degree_used": 0, "opacity_scale": 1.0,
                           "for_rendering": False, "regularizer": "dropout(0.2)"}  # fmt: skip
    assert data["ca_settings"]["samples"] == 3
    assert data["ca_settings"]["seed"] == 4
    assert data["ca_settings"]["drop_rate"] == pytest.approx(0.6)  # 1 - (1 - 0.2) / 2
    assert data["orbit"]["radius"] == pytest.approx(1, rel=0.1)
    assert data["orbit"]["enlarged"] == 1
    assert data["mean"]["orbit"]["ca_exact"] == pytest.approx(sum(v.ca_exact for v in result.views) / 2)
    assert [view["ca"] for view in data["views"]] == [view.ca for view in result.views]
    assert (tmp_path / "ball" / "evaluation.md").read_text() == said[-3] + "\n"
    with Image.open(tmp_path / "ball" / "views" / "orbit" / "001.png") as picture:
        assert picture.size == (40, 40)


@pytest.mark.slow
@pytest.mark.parametrize("on", ["orbit", "scene"])
def test_an_interrupted_measurement_continues_to_the_same_files(tmp_path, options, monkeypatch, on, said):
    save_ply(ball(), tmp_path / "ball.ply")

    def measure(out, **keywords):
        where = FEW if on == "orbit" else options
        score_ply(tmp_path / "ball.ply", where, out, samples=2, **keywords)
        return said

    measure(tmp_path / "whole")
    with interrupted(monkeypatch), pytest.raises(KeyboardInterrupt):
        measure(tmp_path / "cut")
    assert not (tmp_path / "cut" / "evaluation.json").exists()
    (tmp_path / "cut" / "views" / ".001.png.1.part").touch()  # as kill -9 leaves it
    assert f"1 measured before, kept: {tmp_path}/cut/evaluation.partial.json" in measure(tmp_path / "cut")
    files = [
        {str(path.relative_to(tmp_path / out)): path.read_bytes() for path in (tmp_path / out).rglob("*.*")}
        for out in ("whole", "cut")
    ]
    assert files[0] == files[1]


def test_another_model_in_the_same_file_is_measured_anew(tmp_path, monkeypatch):
    expected, _ = orbit(ball(opacity=0.8), tmp_path, "model")
    with interrupted(monkeypatch), pytest.raises(KeyboardInterrupt):
        orbit(ball(opacity=0.9), tmp_path, "model")
    found, said = orbit(ball(opacity=0.8), tmp_path, "model")
    assert repr(found) == repr(expected)
    assert "another model, scene, setting or machine" in said[1]


def test_a_baked_and_a_plain_ply_have_the_same_scores(tmp_path):
    plain, _ = orbit(ball(), tmp_path, "plain", regularizer="dropout(0.2)")
    save_ply(ball(), tmp_path / "baked.ply", bake_p=0.2)
    baked = score_ply(tmp_path / "baked.ply", FEW, tmp_path / "baked")
    unscaled, _ = orbit(ball(), tmp_path, "unscaled")
    for name in ("ca", "ca_exact", "ca_neutral", "cv", "covered"):
        assert baked.mean("orbit", name) == pytest.approx(plain.mean("orbit", name), rel=1e-4)
    assert unscaled.mean("orbit", "covered") > 1.01 * plain.mean("orbit", "covered")
    # at a drop rate of 1/2, not 0.6
    assert unscaled.mean("orbit", "ca_exact") != pytest.approx(plain.mean("orbit", "ca_exact"), rel=0.01)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_size_of_the_world_does_not_matter(tmp_path, factor):
    """Also in front of the near plane, which would cut a model of a millimetre away."""
    one, _ = orbit(ball(), tmp_path, "one")
    other, _ = orbit(ball(radius=factor), tmp_path, "other")
    for name in ("ca", "ca_exact", "cv", "visible", "covered"):
        assert other.mean("orbit", name) == pytest.approx(one.mean("orbit", name), rel=2e-3)


def test_the_background(tmp_path):
    dark = dataclasses.replace(ball(opacity=0.8), sh_dc=ball().sh_dc - 1)
    black, _ = orbit(dark, tmp_path, "black")
    white, _ = orbit(dark, tmp_path, "white", background="white")
    assert white.mean("orbit", "ca_neutral") == pytest.approx(black.mean("orbit", "ca_neutral"), rel=1e-4)
    assert white.mean("orbit", "ca_exact") != pytest.approx(black.mean("orbit", "ca_exact"), rel=0.05)
    with pytest.raises(ValueError, match="black, white, got 'gray'"):
        orbit(ball(), tmp_path, "gray", background="gray")


def test_a_place_is_told_from_an_object(tmp_path):
    room = ball(n=200, radius=20.0)
    both = Gaussians(**{name: torch.cat([x, dict(room.named())[name]]) for name, x in ball(n=300).named()})
    said = orbit(ball(), tmp_path, "object")[1]
    assert not any("a place and" in line for line in said)
    assert "(--scene FOLDER)" in said[-1]  # of any model
    said = orbit(both, tmp_path, "place")[1]
    assert "a place and" in said[1]
    save_ply(both, tmp_path / "arc.ply")
    with hearing() as said:
        score_ply(tmp_path / "arc.ply", dataclasses.replace(FEW, arc=40.0), tmp_path / "arc")
    assert not any("a place and" in line for line in said)


def test_a_ply_on_its_scene(run, options, tmp_path, said):
    out, results = run
    score_ply(out / PLY, options, tmp_path, regularizer="dropout(0.2)")
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["views"] == results["views"]
    assert found["ply"]["regularizer"] == "dropout(0.2)"
    assert any(line.endswith(f" in {tmp_path}") for line in said)
    assert "nobody took a photograph" in said[-1]


@pytest.mark.parametrize(("downscale", "noted"), [(8.0, False), (5.0, True)])
def test_another_size_than_that_of_the_training_is_noted(downscale, noted, run, options, said):
    """A run of `ca-reg run --quick` is made of a tenth of a megapixel, and its photographs are larger."""
    load_for_views(run[0] / PLY, dataclasses.replace(options, downscale=downscale))
    assert any("trained at 20x15" in text for text in said) == noted
    assert any("is measured at 32x24" in text for text in said) == noted


@pytest.mark.slow
@pytest.mark.parametrize("photographs", ["options", "masked"])  # where the noise beside the masks is no measure
def test_a_model_that_fits_no_photograph(tmp_path, photographs, request):
    """It is in the pictures, so only the photographs can tell."""
    options = request.getfixturevalue(photographs)
    points = load_scene(options).points
    right = Gaussians.from_points(points.positions, points.colors, torch.full((len(points.positions),), 0.05),
                                  sh_degree=0, opacity=0.9)  # fmt: skip
    wrong = dataclasses.replace(right, sh_dc=-right.sh_dc)  # a negative
    heard = {}
    for name, gaussians in (("right", right), ("wrong", wrong)):
        save_ply(gaussians, tmp_path / f"{name}.ply")
        with hearing() as heard[name]:
            score_ply(tmp_path / f"{name}.ply", options, tmp_path / name, samples=2)
    assert "of one color" in heard["wrong"][-1]
    assert not any("one color" in text for text in heard["right"])


@pytest.mark.parametrize(("trained", "by", "told"), [("middle", 2, True), ("its own", 2, False), ("middle", 0, False)])
def test_a_model_of_a_trainer_that_takes_no_notice_of_principal_points(options, trained, by, told):
    scene = load_scene(options)
    widths = torch.full((len(scene.points.positions),), 0.1)
    clouds = Gaussians.from_points(scene.points.positions, scene.points.colors, widths, sh_degree=0, opacity=0.9)
    model = TrainedModel(clouds, scene.background)
    photographed = []
    for view in scene.train:  # whose principal points are in the middle
        moved = dataclasses.replace(view, camera=dataclasses.replace(view.camera, cx=view.camera.cx + by))
        seen = model.test_rendering(moved if trained == "its own" else view)
        photographed.append(dataclasses.replace(moved, image=seen.image.clamp(0, 1).round(decimals=2)))
    with hearing() as said:
        log_other_center(model, dataclasses.replace(scene, train=tuple(photographed)), "model.ply")
    assert any("cx and cy" in text for text in said) == told


def test_a_ply_in_another_frame_is_refused_before_anything_is_written(tmp_path, options):
    save_ply(dataclasses.replace(ball(), means=ball().means + 1e4), tmp_path / "far.ply")
    with pytest.raises(ValueError, match="cameras of synthetic"):
        score_ply(tmp_path / "far.ply", options)
    assert [path.name for path in tmp_path.iterdir()] == ["far.ply"]


@pytest.mark.data
@pytest.mark.parametrize(("name", "count"), [("plant_20k_sh3zero", 20_000), ("spot_10k_mesh2splat_sh3zero", 10_000)])
def test_models_of_other_people(name, count, data_root, tmp_path):
    result = score_ply(data_root / "splats" / f"{name}.ply", FEW, tmp_path)
    data = json.loads((tmp_path / "evaluation.json").read_text())
    assert (data["ply"]["gaussians"], data["ply"]["sh_degree_used"]) == (count, 0)
    for view in result.views:
        assert 0.1 < view.covered < 0.4  # all of it in the picture, and not tiny
        assert 0 < view.ca_neutral < view.ca_exact  # the background can only add to the mean of a dark one
