import contextlib
import dataclasses
import io
import json
import math

import matplotlib
import numpy as np
import pytest
import torch
from oracles import brute_force, random_scene
from PIL import Image

from benchmarks import attribution as shares_module
from benchmarks.attribution import study_attribution
from ca_reg import Reason
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import blend_weights, colored_by, concentration, mean_shares
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.model.ply import load_ply
from reference_trainer.runs.folder import CHECKPOINT, CONFIG
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.scene import View
from reference_trainer.training.trainer import Trainer


@pytest.fixture(scope="module")
def run(tmp_path_factory, options, short):
    """Opaque enough to have a score after a few steps."""
    out = tmp_path_factory.mktemp("run")
    trainer = Trainer(load_scene(options), dataclasses.replace(short, initial_opacity=0.9, noise=0.0))
    trainer.train(until=4)
    trainer.save(out / CHECKPOINT)
    config = {"scene": dataclasses.asdict(options), "config": dataclasses.asdict(trainer.config)}
    write_json(out / CONFIG, config)
    return out


@pytest.fixture(scope="module")
def study(run):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        data = study_attribution(run)
    return data, run / "attribution", printed.getvalue()


def luminance(gaussians: Gaussians) -> torch.Tensor:
    """Of the constant colors."""
    return (gaussians.sh_dc[:, 0] * SH_C0 + 0.5).double() @ torch.tensor([0.2126, 0.7152, 0.0722]).double()


def test_the_shares_in_the_file_add_up_to_the_score_that_is_printed(run, study):
    data, out, printed = study
    model, scene = load_run_model(run)
    exact = model.exact_ca_score(drop_rate=0.5)
    values = [exact(model.gaussians.opacities, view).value for view in scene.test]
    assert list(data["views"].values()) == values
    assert data["score"] == sum(values) / len(values) > 0
    with np.load(out / "shares.npz", allow_pickle=False) as file:
        arrays = dict(file)
    assert {name: (x.shape, x.dtype) for name, x in arrays.items()} == dict.fromkeys(
        ("shares", "total_effects", "blend_weights"), ((len(model.gaussians),), np.dtype("float64"))
    )
    shares = arrays["shares"]
    assert shares.sum() == pytest.approx(data["score"], rel=1e-5)  # the variance map is float32
    table = [line for line in printed.splitlines() if line.startswith("|")]
    rows = dict(line.strip("| ").split(" | ") for line in table[2:])
    assert float(rows["score x1e-3, mean over test views"]) == pytest.approx(shares.sum() * 1e3, rel=1e-5)
    assert float(rows["sum of the shares x1e-3"]) == pytest.approx(shares.sum() * 1e3, rel=1e-6)
    effects = arrays["total_effects"]
    assert (effects >= shares * (1 - 1e-4) - 1e-12).all()
    assert data["sum_of_total_effects"] == pytest.approx(effects.sum(), rel=1e-12)
    assert effects.sum() > shares.sum()
    assert json.loads((out / "attribution.json").read_text())["score"] == data["score"]


def test_the_plys_hold_the_same_gaussians_colored_by_rank(run, study):
    data, out, _ = study
    model = load_run_model(run)[0]
    with np.load(out / "shares.npz") as file:
        shares, weights = (torch.from_numpy(file[name]) for name in ("shares", "blend_weights"))
    for name, values, ends in (
        ("attribution", shares, data["color_scales"]["share"]),
        (
            "attribution_per_weight",
            torch.where(shares > 0, shares / weights, 0),
            data["color_scales"]["share_per_weight"],
        ),
    ):
        loaded = load_ply(out / f"{name}.ply")
        for part in ("means", "log_scales", "quaternions"):
            assert torch.equal(getattr(loaded.gaussians, part), getattr(model.gaussians, part))
        assert loaded.opacity_scale == 0.8  # trained with dropout 0.2
        torch.testing.assert_close(loaded.gaussians.opacities, 0.8 * model.gaussians.opacities)
        assert loaded.gaussians.sh_rest.shape[1] == 15
        assert not loaded.gaussians.sh_rest.any()
        bright = luminance(loaded.gaussians)[values.argsort()]
        assert (bright.diff() >= -1e-6).all()
        assert bright[-1] - bright[0] > 0.2
        mean = shares.sum() / len(shares) if name == "attribution" else shares.sum() / weights.sum()
        assert math.sqrt(ends[0] * ends[1]) == pytest.approx(mean.item() * (10 if name == "attribution" else 1))


def test_every_view_has_a_picture_of_four_panels(run, study):
    _, out, _ = study
    names = [view.name for view in load_run_model(run)[1].test]
    assert sorted(path.stem for path in (out / "views").iterdir()) == sorted(names)
    with Image.open(out / "views" / f"{names[0]}.png") as picture:
        assert picture.height > 15  # and a line of labels
        assert picture.width >= 4 * 20 + 3 * 4
    assert "pale yellow" in (out / "README.md").read_text()


def test_views_of_the_same_name_in_two_folders_keep_their_pictures(run, tmp_path, monkeypatch):
    model, scene = load_run_model(run)
    views = tuple(dataclasses.replace(v, name=n) for v, n in zip(scene.test, ("a/r.png", "b/r.png"), strict=False))
    monkeypatch.setattr(shares_module, "load_run_model", lambda *a: (model, dataclasses.replace(scene, test=views)))
    study_attribution(run, tmp_path)
    assert sorted(path.name for path in (tmp_path / "views").iterdir()) == ["a_r.png", "b_r.png"]


def test_colors_rise_with_the_value_on_a_logarithmic_scale():
    n = 500
    values = torch.cat(
        [torch.tensor([0.0]), torch.logspace(-4, 4, n - 2, dtype=torch.float64), torch.tensor([math.inf])]
    )
    start = Gaussians.from_points(torch.rand(n, 3), torch.rand(n, 3), torch.ones(n), sh_degree=2)
    start = dataclasses.replace(start, sh_rest=torch.ones_like(start.sh_rest))
    colored = colored_by(start, values, 1e-2, 1e3)
    bright = luminance(colored)
    assert (bright.diff() >= -1e-6).all()
    assert len(bright.round(decimals=6).unique()) > 200
    assert torch.equal(colored.sh_dc[values <= 1e-2].unique(dim=0), colored.sh_dc[:1])
    assert torch.equal(colored.sh_dc[values >= 1e3].unique(dim=0), colored.sh_dc[-1:])
    assert not colored.sh_rest.any()
    assert torch.equal(colored.opacity_logits, start.opacity_logits)
    (middle,) = colored_by(start[:1], torch.tensor([10**0.5]), 1e-2, 1e3).sh_dc * SH_C0 + 0.5  # half way: 10^(-2 + 5/2)
    expected = torch.tensor(matplotlib.colormaps["inferno"](128)[:3])
    torch.testing.assert_close(middle[0].double(), expected, rtol=0, atol=1e-6)


def test_blend_weights_are_those_of_brute_force():
    """Colors that are the rows of the identity make one image of each Gaussian's weight."""
    n, scale = 30, 0.8
    scene = random_scene(n, 24, 18, seed=5)
    pose = scene.camera.world_to_camera.clone()
    pose[:3, 3] += torch.tensor([0.2, 0.1, 0.4])
    cameras = [scene.camera, dataclasses.replace(scene.camera, world_to_camera=pose)]
    gaussians = Gaussians(
        scene.means,
        scene.scales.log(),
        scene.quaternions,
        torch.logit(scene.opacities),
        torch.zeros(n, 1, 3, dtype=torch.float64),
        torch.zeros(n, 0, 3, dtype=torch.float64),
    )
    model = TrainedModel(gaussians, torch.ones(3, dtype=torch.float64), f"dropout({1 - scale})")
    views = [View(str(i), camera, torch.zeros(3, 18, 24)) for i, camera in enumerate(cameras)]
    identity = torch.eye(n, dtype=torch.float64)
    expected = sum(
        brute_force(*scene[:3], scale * scene.opacities, identity, camera)[0].sum((1, 2)) for camera in cameras
    )
    assert (expected == 0).any()
    torch.testing.assert_close(blend_weights(model, views), expected, rtol=1e-9, atol=1e-12)


def test_a_view_without_a_score_does_not_count(run):
    model, scene = load_run_model(run)
    view = scene.test[0]
    pose = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ view.camera.world_to_camera  # turned around
    away = dataclasses.replace(view, camera=dataclasses.replace(view.camera, world_to_camera=pose))
    alone, _ = mean_shares(model, [view])
    both, results = mean_shares(model, [away, view])
    assert [result.reason is Reason.OK for result in results] == [False, True]
    assert torch.equal(both, alone)
    for views in ([away], []):
        with pytest.raises(ValueError, match=f"the {len(views)} views"):
            mean_shares(model, views)


def test_shares_are_the_mean_over_the_views(run):
    model, scene = load_run_model(run)
    parts = [mean_shares(model, [view], drop_rate=0.3)[0] for view in scene.train]
    shares, results = mean_shares(model, scene.train, drop_rate=0.3)
    torch.testing.assert_close(shares, torch.stack(parts).mean(0), rtol=1e-12, atol=0)
    assert sum(result.value for result in results) / len(results) == pytest.approx(shares.sum().item(), rel=1e-5)


def test_concentration_counts_from_the_largest():
    shares = torch.tensor([1.0, 3.0, 1.0, 1.0])
    assert concentration(shares) == {"top 0.1%": 0.5, "top 1%": 0.5, "top 10%": 0.5, "half": 0.25}
    assert concentration(torch.ones(2000)) == pytest.approx(
        {"top 0.1%": 0.001, "top 1%": 0.01, "top 10%": 0.1, "half": 0.5}
    )


def test_other_views_and_mistakes(run, tmp_path):
    data = study_attribution(run, tmp_path, split="train", drop_rate=0.25)
    assert sorted(data["views"]) == sorted(view.name for view in load_run_model(run)[1].train)
    assert data["drop_rate"] == 0.25
    with pytest.raises(ValueError, match=r"split .*'test', got 'val'"):
        study_attribution(run, split="val")
    with pytest.raises(ValueError, match=r"drop rate 0\.0 is 0"):
        study_attribution(run, drop_rate=0.0)
    with pytest.raises(FileNotFoundError, match="holds no run"):
        study_attribution(tmp_path / "nowhere")


def test_a_run_whose_opacities_depend_on_the_camera(run, tmp_path, options, short):
    """Its PLYs hold the plain ones."""
    trainer = Trainer(
        load_scene(options),
        dataclasses.replace(short, regularizer="depth(0.4, scale=True)", dropout=0.0, noise=0.0, initial_opacity=0.9),
    )
    trainer.train(until=4)
    trainer.save(tmp_path / CHECKPOINT)
    config = {"scene": dataclasses.asdict(options), "config": dataclasses.asdict(trainer.config)}
    write_json(tmp_path / CONFIG, config)
    study_attribution(tmp_path)
    stored = load_ply(tmp_path / "attribution" / "attribution.ply")
    torch.testing.assert_close(stored.gaussians.opacities, trainer.gaussians.opacities.detach())
