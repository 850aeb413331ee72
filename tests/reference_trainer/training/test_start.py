"""Training that starts from somebody's model instead of points."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.assembly import make_regularizer
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan
from reference_trainer.training.trainer import Trainer


def model(degree: int = 2, **learned: torch.Tensor) -> Gaussians:
    """Gaussians of all sizes, orientations, opacities and colors, in front of the cameras of the built-in scene."""
    draw = torch.Generator().manual_seed(degree)
    start = load_scene(SceneOptions("synthetic", downscale=5)).points.positions[:60]
    normal = lambda *shape: torch.randn(*shape, generator=draw)  # noqa: E731
    bands = (degree + 1) ** 2 - 1
    return Gaussians(
        means=start, log_scales=normal(60, 3) - 2, quaternions=normal(60, 4), opacity_logits=normal(60),
        sh_dc=normal(60, 1, 3), sh_rest=normal(60, bands, 3) / 5, learned=learned,
    )  # fmt: skip


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "point_cloud.ply"
    save_ply(model(), path)
    return path


def scene_with(ply):
    return load_scene(SceneOptions("synthetic", downscale=5, init=str(ply)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_all_parameters_are_taken_and_the_bands_that_are_asked_for(ply, degree):
    start, begun = load_ply(ply).gaussians, Trainer(scene_with(ply), TrainConfig(sh_degree=degree)).gaussians
    for name, x in begun.named():
        if name != "sh_rest":
            assert torch.equal(x, dict(start.named())[name]), name
    kept = min(degree, 2) ** 2 + 2 * min(degree, 2)
    assert begun.sh_degree == degree
    assert torch.equal(begun.sh_rest[:, :kept], start.sh_rest[:, :kept])
    assert not begun.sh_rest[:, kept:].any()


def test_the_first_step_sees_the_model_as_it_is(ply):
    """By its loss, the error of a render with all bands; a first step of a training from points has none."""

    def errors(degree: int) -> list[float]:
        renders = [
            render_gaussians(load_ply(ply).gaussians, view.camera, scene.background, sh_degree=degree).image
            for view in scene.train
        ]
        return [(image - view.image).abs().mean().item() for image, view in zip(renders, scene.train, strict=True)]

    scene = scene_with(ply)
    loss = Trainer(scene, TrainConfig(iterations=5, loss="photometric(0.0)")).train_step()
    assert loss in [pytest.approx(error, rel=1e-5) for error in errors(2)]
    assert loss not in [pytest.approx(error, rel=1e-3) for error in errors(0)]


def test_it_goes_on_with_what_a_regularizer_has_learned(tmp_path):
    learned = torch.linspace(-1, 1, 60)
    name = next(iter(make_regularizer(TrainConfig(regularizer="concrete")).learns))
    save_ply(model(**{name: learned}), tmp_path / "b.ply")
    config = TrainConfig(regularizer="concrete")
    assert torch.equal(Trainer(scene_with(tmp_path / "b.ply"), config).gaussians.learned[name], learned)
    assert set(Trainer(scene_with(tmp_path / "b.ply"), TrainConfig()).gaussians.learned) == set()


def test_resumed_bit_for_bit(ply, tmp_path, busy):
    scene = scene_with(ply)
    config = dataclasses.replace(busy, iterations=9)
    whole, first = Trainer(scene, config), Trainer(scene, config)
    whole.train()
    first.train(until=4)
    first.save(tmp_path / "checkpoint.pt")
    second = Trainer.load(tmp_path / "checkpoint.pt", scene)
    second.train()
    one, other = whole.optimizer.state_dict(), second.optimizer.state_dict()
    for name, x in one["gaussians"].items():
        assert torch.equal(x, other["gaussians"][name])
        assert all(torch.equal(moment, other["moments"][name][key]) for key, moment in one["moments"][name].items())
    assert len(whole.gaussians) != 60  # density control did its work


def test_opaque_gaussians_can_be_trained(tmp_path):
    opaque = dataclasses.replace(model(), opacity_logits=torch.tensor([math.inf, -math.inf] * 30))
    save_ply(opaque, tmp_path / "a.ply")
    trainer = Trainer(scene_with(tmp_path / "a.ply"), TrainConfig(iterations=2))
    trainer.train()
    assert all(bool(x.isfinite().all()) for _, x in trainer.gaussians.named())


def test_the_plan_knows(ply):
    plan = make_plan(scene_with(ply), TrainConfig(iterations=10))  # too few for a band, if they came one by one
    reasons = {item.name: item.reason for item in plan.items}
    assert "starts from degree 2" in reasons["SH bands"]
    assert "sizes of their own" in reasons["size of initial points"]
    assert plan.applied(TrainConfig(iterations=10)).sh_degree == 3


@pytest.mark.parametrize("command", ["train", pytest.param("compare", marks=pytest.mark.slow)])
def test_from_the_command_line(ply, tmp_path, capsys, monkeypatch, command):
    monkeypatch.chdir(tmp_path)  # the file is named from here, and a worker finds it all the same
    extra = ["--strategies", "dropout", "--seeds", "1"] if command == "compare" else ["--dropout", "0.2"]
    arguments = [command, "--init", ply.name, "--downscale", "5", "--iterations", "2", "--monitor-every", "0",
                 "--out", "run", "--densify-every", "0", *extra]  # fmt: skip
    main(arguments)
    run = tmp_path / "run" / ("dropout/seed_0" if command == "compare" else "")
    trained = load_ply(run / "point_cloud.ply")
    assert len(trained.gaussians) == 60
    assert (trained.gaussians.means - model().means).abs().max() < 0.05
    if command == "train":
        assert re.search(r"60 Gaussians of degree 2 .*point_cloud\.ply", capsys.readouterr().out)
        main(arguments)
        assert "complete, nothing to do" in capsys.readouterr().out


def plain_cloud(path):
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
                    "end_header\n0 0 1\n")  # fmt: skip


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (plain_cloud, "for --points: .* not a 3D Gaussian Splatting PLY: its vertices lack f_dc_0"),
        (lambda path: path.write_text("no"), "for --points: .* not a PLY file"),
        (lambda path: save_ply(model(), path, bake_p=0.2), "holds opacities of the test, not the plain ones"),
        (lambda path: save_ply(model(), path, opacities=torch.rand(60)), "opacities of the test"),
        (lambda path: save_ply(model()[:0], path), "holds no Gaussians"),
    ],
)
def test_what_is_no_start(tmp_path, write, message):
    write(tmp_path / "a.ply")
    with pytest.raises(ValueError, match=message):
        scene_with(tmp_path / "a.ply")


def test_no_file_and_two_starts(ply):
    with pytest.raises(FileNotFoundError, match=r"no model nowhere\.ply"):
        scene_with("nowhere.ply")
    with pytest.raises(ValueError, match=r"init .*points: leave out"):
        load_scene(SceneOptions("synthetic", init=str(ply), points="random"))
