import dataclasses
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import Evaluation, ViewScores
from reference_trainer.evaluation.results import PARTIAL
from reference_trainer.evaluation.tables import EXACT, evaluation_table
from reference_trainer.model.ply import load_ply
from reference_trainer.runs import measure as measure_module
from reference_trainer.runs.folder import BAKED_PLY, PLY, FolderInUseError, run_lock
from reference_trainer.runs.measure import load_run_model, measure, render_run
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes.images import read_image
from reference_trainer.training.config import TrainConfig


def both(scene):
    return {"train": scene.train, "test": scene.test}


def test_the_flag_of_the_evaluation_and_that_of_the_training_are_the_same(run, scaled, tmp_path):
    """Also dropout and noise together: the run has both."""
    (plain, before), (out, results) = run, scaled
    one, other = (load_ply(folder / PLY).gaussians for folder in (plain, out))
    assert all(torch.equal(x, y) for (_, x), (_, y) in zip(one.named(), other.named(), strict=True))
    model, scene = load_run_model(plain, regularizer="dropout(0.2) + noise(0.3, scale=True)")
    measure(model, both(scene), tmp_path, about={})
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["views"] == results["views"]
    assert found["regularizer"] == "dropout(0.2) + noise(0.3, scale=True)"
    for one, other in zip(results["views"], before["views"], strict=True):
        assert one["psnr"] != other["psnr"]
        assert [one[name] for name in ("ca", "ca_half", "ca_exact")] == [
            other[name] for name in ("ca", "ca_half", "ca_exact")
        ]


def test_the_monitor_and_the_pictures_use_the_same_opacities(scaled, tmp_path):
    out, results = scaled
    (line,) = (out / "ca.jsonl").read_text().splitlines()
    assert json.loads(line)["psnr/test"] == pytest.approx(results["mean"]["test"]["psnr"])
    folder = render_run(out, "test", tmp_path)
    for path in folder.iterdir():
        assert path.read_bytes() == (out / "views" / "test" / path.name).read_bytes()


def test_the_monitor_counts_the_pixels_inside_the_masks(masked, tmp_path):
    results = run_experiment(masked, TrainConfig(iterations=1), tmp_path)
    (line,) = (tmp_path / "ca.jsonl").read_text().splitlines()
    for split in ("train", "test"):
        assert json.loads(line)[f"psnr/{split}"] == pytest.approx(results["mean"][split]["psnr"])


def test_noise_alone_has_a_ply_for_viewers_too(options, tmp_path):
    config = TrainConfig(iterations=1, regularizer="noise(0.8, clip=True, scale=True)")
    run_experiment(options, config, tmp_path, monitoring=Monitoring(0))
    model = load_run_model(tmp_path)[0]
    assert (model.dropout, model.factor) == (0.0, None)
    torch.testing.assert_close(load_ply(tmp_path / BAKED_PLY).gaussians.opacities, model.test_opacities)


def test_a_run_is_not_rendered_as_if_trained_with_nonsense(run):
    with pytest.raises(ValueError, match="no regularizer 'noize'"):
        load_run_model(run[0], regularizer="noize(0.8)")


def test_measuring_a_run_again_gives_what_the_run_found(run, tmp_path, said):
    out, results = run
    model, scene = load_run_model(out)
    measure(model, both(scene), tmp_path / "new", about={"scene": "a name"})
    found = json.loads((tmp_path / "new" / "evaluation.json").read_text())
    assert found["views"] == results["views"]
    assert found["mean"] == results["mean"]
    assert found["ca_settings"]["drop_rate"] == pytest.approx(0.6)
    assert found["scene"] == "a name"
    assert found["background"] == [0.0, 0.0, 0.0]
    assert (tmp_path / "new" / "views" / "test" / "test_0_panel.png").exists()
    assert any("| mean test |" in text for text in said)


def test_pictures_of_other_views_do_not_stay_beside_the_scores(run, tmp_path):
    model, scene = load_run_model(run[0])
    measure(model, {"train": scene.train[:1], "test": scene.test[:2]}, tmp_path, about={}, samples=2)
    (tmp_path / "views" / "test" / "mine.png").write_bytes(b"somebody else's")
    measure(model, {"test": scene.test[1:2]}, tmp_path, about={}, samples=2)
    found = {path.relative_to(tmp_path / "views").as_posix() for path in (tmp_path / "views").rglob("*")}
    assert found == {"test", "test/mine.png", "test/test_1.png", "test/test_1_panel.png"}


def test_the_folder_is_locked_until_the_last_file_has_changed(run, tmp_path, monkeypatch):
    """Otherwise a second evaluation that begins in between would lose its partial scores to the first."""
    model, scene = load_run_model(run[0])
    touched = []

    def watched(change):
        def locked_change(path, *arguments, **options):
            if path.parent == tmp_path and path.name.startswith("evaluation"):
                touched.append(path.name)
                with pytest.raises(FolderInUseError), run_lock(tmp_path):
                    pass
            return change(path, *arguments, **options)

        return locked_change

    for owner, name in ((Path, "unlink"), (measure_module, "write_json"), (measure_module, "write_text")):
        monkeypatch.setattr(owner, name, watched(getattr(owner, name)))
    measure(model, {"test": scene.test[:1]}, tmp_path, about={})
    assert touched == ["evaluation.json", "evaluation.md", "evaluation.partial.json"]
    assert not (tmp_path / PARTIAL).exists()


def test_the_seed_decides_the_masks(run, tmp_path):
    model, scene = load_run_model(run[0])
    views = {"train": scene.train[:1]}
    one, same, other = (measure(model, views, tmp_path, about={}, samples=3, seed=seed) for seed in (0, 0, 1))
    assert one.views[0].ca == same.views[0].ca != other.views[0].ca
    assert one.views[0].psnr == other.views[0].psnr


def test_the_table_has_one_row_per_view_and_the_means():
    views = [
        ViewScores(f"v{i}", "test", 20.0 + i, 0.5, 0.25, 2e-3, 1e-4, 3e-3, 4e-3, 4.5e-3, 5e-3, 0.9, 0.7, 0.04)
        for i in range(2)
    ]
    lines = evaluation_table(Evaluation(views, 9, "vgg").as_dict()).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    head = ["view", "PSNR (dB)", "SSIM", "LPIPS", EXACT, "exact CA at its own drop rate (1e-3)",
            "neutral CA at its own drop rate (1e-3)", "CA (5 renders) (1e-3)", "its std error (1e-3)", "visible",
            "covered", "CV"]  # fmt: skip
    assert cells[0] == head
    assert cells[2] == [
        "test v0",
        "20.00",
        "0.500",
        "0.250",
        "4.50",
        "4.00",
        "5.00",
        "2.00",
        "0.10",
        "0.900",
        "0.700",
        "0.0400",
    ]
    assert cells[4][:2] == ["mean test", "20.50"]
    plain = [dataclasses.replace(view, psnr=math.nan, lpips=math.nan) for view in views]
    mixed = Evaluation([*plain, dataclasses.replace(views[0], lpips=math.nan)], 9)
    head = evaluation_table(mixed.as_dict()).splitlines()[0]
    assert "PSNR" in head
    assert "LPIPS" not in head


@pytest.mark.parametrize(("what", "names"), [("test", ["test_0", "test_1", "test_outside"]), ("train", None)])
def test_views_are_rendered_as_in_the_run(run, what, names):
    out, _ = run
    folder = render_run(out, what)
    assert folder == out / f"render_{what}"
    found = sorted(path.stem for path in folder.iterdir())
    assert found == (names or [f"train_{i}" for i in range(3)])
    for name in found:
        assert (folder / f"{name}.png").read_bytes() == (out / "views" / what / f"{name}.png").read_bytes()


def test_views_of_the_same_name_in_two_folders_are_all_rendered(run, tmp_path, monkeypatch):
    trainer = measure_module.load_run(run[0])
    names = ("a/r_0.png", "b/r_0.png", "r_1.png")
    test = tuple(dataclasses.replace(v, name=n) for v, n in zip(trainer.scene.test, names, strict=True))
    trainer.scene = dataclasses.replace(trainer.scene, test=test)
    monkeypatch.setattr(measure_module, "load_run", lambda *arguments, **trust: trainer)
    render_run(run[0], "test", tmp_path)
    for name, view in (("a_r_0", "test_0"), ("b_r_0", "test_1"), ("r_1", "test_outside")):
        assert (tmp_path / f"{name}.png").read_bytes() == (run[0] / "views" / "test" / f"{view}.png").read_bytes()


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_a_flight_begins_and_ends_at_training_cameras(suffix, run, tmp_path, said, monkeypatch):
    if suffix == ".mp4":
        av = pytest.importorskip("av", reason="needs ca_reg[photos]")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    out, _ = run
    folder = render_run(out, "flight", tmp_path / "flight", frames=5)
    film = folder / f"flight{suffix}"
    pictures = [folder / f"{i:04d}.png" for i in range(5)]
    assert sorted(folder.iterdir()) == [*pictures, film]
    if suffix == ".mp4":
        with av.open(str(film)) as file:
            assert file.streams.video[0].average_rate == 20
            frames = [frame.to_image() for frame in file.decode(video=0)]
        size = (20, 14)  # even
    else:
        with Image.open(film) as file:
            frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(file)]
        size = (20, 15)
    assert [frame.size for frame in frames] == [size] * 5
    for frame, path in zip(frames, pictures, strict=True):  # of so few pixels little survives but the colors
        with Image.open(path) as picture:
            other = np.asarray(picture.crop((0, 0, *size))).astype(float)
        assert np.abs(np.asarray(frame) - other).mean() < 12
    for frame, view in (("0000", "train_0"), ("0002", "train_1"), ("0004", "train_2")):
        one, other = (read_image(path)[0] for path in (folder / f"{frame}.png", out / f"views/train/{view}.png"))
        assert (one - other).abs().max() <= 1 / 255 + 1e-6
    assert said == [f"The film is {film}", f"5 pictures are in {folder}"]
    (folder / "0006.png").write_bytes(b"somebody else's")
    render_run(out, "flight", folder, frames=4)  # nothing is left of the longer one
    assert sorted(folder.iterdir()) == [*pictures[:4], folder / "0006.png", film]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / film.name).write_bytes(b"of another program")
    with pytest.raises(ValueError, match="holds flight"):
        render_run(out, "flight", tmp_path / "mine", frames=2)


def test_where_a_run_is_expected_to_be_wrong(run, tmp_path):
    out, _ = run
    model, scene = load_run_model(out)
    error = ErrorMaps(model, scene.train)(scene.test[0]).error
    threshold = error.median().item()
    render_run(out, "error", tmp_path, mask=threshold)
    assert len([*tmp_path.iterdir()]) == 3 * len(scene.test)
    mask = read_image(tmp_path / "test_0_mask.png")[0]
    assert torch.equal(mask[0] > 0.5, error > threshold)
    assert 0 < mask.mean() < 1
    render_run(out, "error", tmp_path / "no_mask")
    assert len([*(tmp_path / "no_mask").iterdir()]) == 2 * len(scene.test)


@pytest.mark.parametrize(
    ("test", "found"),
    [
        (("r.png", "r_error.png", "a/r_mask.png"), ["a_r_mask", "r", "r_error.png"]),
        ((), ["around_000", "around_001", "around_002", "between_000", "between_001"]),
    ],
)
def test_no_picture_of_an_expected_error_takes_the_place_of_a_render(test, found, run, tmp_path, monkeypatch):
    trainer = measure_module.load_run(run[0])
    views = tuple(dataclasses.replace(v, name=name) for v, name in zip(trainer.scene.test, test, strict=False))
    trainer.scene = dataclasses.replace(trainer.scene, test=views)
    monkeypatch.setattr(measure_module, "load_run", lambda *arguments, **trust: trainer)
    render_run(run[0], "error", tmp_path, mask=0.1)
    ends = "", "_error", "_mask"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{n}{end}.png" for n in found for end in ends)
