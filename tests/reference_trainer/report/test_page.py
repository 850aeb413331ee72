import dataclasses
import json
import re
import shutil
import zlib
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from heard import hearing
from PIL import Image
from reports import Parsed, two_of_each, unfinished

from ca_reg.monitor import LOG_NAME, read_dynamics
from reference_trainer.cli import main
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import Heat, blend_weights, mean_shares, share_per_weight
from reference_trainer.report import page as page_module
from reference_trainer.report.findings import find, pictures_of
from reference_trainer.report.packing import quantized
from reference_trainer.report.page import compare_two, write_report
from reference_trainer.runs.folder import CHECKPOINT, CONFIG, run_settings
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig


def unpacked(run: dict) -> dict[str, np.ndarray]:
    """The numbers of a model of the page, read as their docstrings say."""
    planes = np.frombuffer(zlib.decompress(b64decode(run["values"]["text"])), np.uint8)
    low, high = planes.reshape(-1, 2, run["count"]).astype(int).transpose(1, 0, 2)
    coded = (low + 256 * high).T
    table = np.where(coded % 2, -(coded + 1) // 2, coded // 2) * np.array(run["values"]["steps"])
    ends = np.cumsum([3, 3, 4, 1, 3])
    names = "means", "log_scales", "quaternions", "opacities", "heat", "sh"
    found = dict(zip(names, np.split(table, ends, axis=1), strict=True))
    found["means"] = run["center"] + run["scale"] * np.sign(found["means"]) * np.expm1(np.abs(found["means"]))
    return found


@pytest.fixture(scope="module")
def pair(tmp_path_factory, run, scaled):
    """Two finished runs, of which only the second was measured while it trained, and the page about both."""
    runs, out = [run[0], scaled[0]], tmp_path_factory.mktemp("pair") / "report.html"
    with hearing() as said:
        assert write_report(runs, out, views=2) == out
    assert str(out) in said[-1]
    return runs, Parsed(out)


@pytest.fixture(scope="module")
def found(run):
    """What a page shows of a run."""
    return find(run[0], "a run", views=1)


def test_a_page_holds_all_that_it_shows(pair):
    _, page = pair
    addresses = [x for _, of in page.tags for name, x in of.items() if name in ("src", "href", "action", "data")]
    assert not addresses
    assert not {tag for tag, _ in page.tags} & {"link", "iframe", "object", "base"}
    assert not re.findall(r"https?:|@import|url\(|\bfetch\(|XMLHttp|WebSocket|import\(", page.text)
    (policy,) = [of["content"] for tag, of in page.tags if of.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:;")


def test_the_tables_are_those_of_the_runs(pair):
    runs, page = pair
    names = ["Dropout 0.2 + noise 0.3", "Dropout 0.2 + noise(0.3, scale=True)"]
    assert [each["label"] for each in page.data["runs"]] == names
    assert [each["name"] for each in page.data["strategies"]] == names
    for i, (run, name) in enumerate(zip(runs, names, strict=True)):
        results = json.loads((run / "results.json").read_text())
        for view in results["views"]:
            shown = page_module.view_name(view["split"], view["name"])
            assert f"| {shown} | {view['psnr']:.2f} |" in page.data["perView"][name]
        column = page.data["scores"][0]
        assert (column["split"], column["title"]) == ("test", "PSNR (dB)")
        assert column["cells"][i]["text"] == f"{results['mean']['test']['psnr']:.2f}"
        assert f"{name}: 11 steps with dropout(0.2) + noise(0.3" in " ".join(page.data["about"])
        assert f"| {name} | " in page.data["attribution"]
    assert page.data["made"].startswith(f"ca-reg report {runs[0]} {runs[1]} --views 2 --out ")
    assert "| noise | 0.3 | 0.0 |" in page.data["settings"]
    assert "\n| sh_rate |" not in page.data["settings"]  # the default in both


def test_the_curves_are_those_that_were_measured(pair):
    runs, page = pair
    without, with_ = (each["label"] for each in page.data["runs"])
    logged = read_dynamics(runs[1])
    assert [(curve["run"], curve["group"]) for curve in page.data["curves"]] == [(with_, "train"), (with_, "test")]
    for curve in page.data["curves"]:
        np.testing.assert_array_equal(curve["step"], logged["step"])
        np.testing.assert_allclose(curve["ca"], 1e3 * logged[f"ca/{curve['group']}"], atol=1e-4)
        np.testing.assert_allclose(curve["psnr"], logged[f"psnr/{curve['group']}"], atol=1e-4)
    assert page.data["exact"]
    (note,) = (note for note in page.data["notes"] if "against the step" in note)
    assert note.startswith(f"{without}: no CA and PSNR")


def test_the_views_come_with_their_pictures(pair):
    runs, page = pair
    names = [view["name"] for view in page.data["views"]]
    assert names == [
        "test 0",
        "test outside",
        "train 0",
        "train 2",
    ]
    model, scene = load_run_model(runs[1])
    for view, entry in zip(two_of_each(scene), page.data["views"], strict=True):
        pose = np.array(entry["pose"]).reshape(3, 4)
        np.testing.assert_array_equal(pose, view.camera.world_to_camera[:3].numpy())
        render = model.test_rendering(view).image
        for uri, expected in ((entry["photograph"], view.image), (entry["pictures"][1]["render"], render)):
            with Image.open(BytesIO(b64decode(uri.partition(",")[2]))) as file:
                rendered = np.asarray(file).transpose(2, 0, 1) / 255
            assert np.abs(rendered - expected.clamp(0, 1).numpy()).mean() < 0.02  # compressed
        expected = set() if entry["name"].startswith("train") else {"expected error"}
        assert set(entry["pictures"][1]) == {"render", "error", "co-adaptation", "caption"} | expected


@pytest.mark.slow
def test_the_worst_views_that_nobody_took_come_first(run, found, tmp_path, monkeypatch):
    monkeypatch.setattr(page_module, "pictures_of", lambda _, view, expected: {"caption": str(expected.psnr)})
    unseen = [(view, map_._replace(psnr=float(30 - i))) for i, (view, map_) in enumerate(found.unseen)]
    shown = strategies(dataclasses.replace(found, unseen=unseen), [run[0]], tmp_path, monkeypatch)["unseen"]
    captions = [float(view["pictures"][0]["caption"]) for view in shown]
    assert captions == sorted(captions)
    names = [view["name"] for view in shown]
    assert len(set(names)) == len(names)
    for kind in ("between", "beyond"):
        least = {name: min(m.psnr for v, m in unseen if v.name == name) for name in {v.name for v, _ in unseen}}
        expected = sorted((x for name, x in least.items() if name.startswith(kind)))[: page_module.EACH]
        assert [x for x, name in zip(captions, names, strict=True) if name.startswith(kind)] == expected


def test_the_page_tells_what_hangs_and_how_to_remove_it(run, found, tmp_path, monkeypatch):
    hangs = {"hangs": "1 of 2 Gaussians hang.", "removed": ["Removed after step 9: 3."]}
    hanging, none = (
        strategies(dataclasses.replace(found, **of), [run[0]], tmp_path, monkeypatch)["evidence"] for of in (hangs, {})
    )
    first, line = (line for line in hanging if line not in none)
    assert "after step 9" in first
    assert "1 of 2 Gaussians hang" in line
    assert f"ca-reg clean {run[0]}/point_cloud.ply --scene synthetic --hanging --downscale 8" in line
    shutil.copytree(run[0], tmp_path / "unfinished", ignore=shutil.ignore_patterns("*.ply"))
    of = dataclasses.replace(found, **hangs)
    (unfinished,) = {*strategies(of, [tmp_path / "unfinished"], tmp_path, monkeypatch)["evidence"]} - {*none, first}
    assert "ca-reg clean" not in unfinished


def test_a_mask_that_leaves_no_pixel_leaves_nothing_to_expect(run):
    model, scene = load_run_model(run[0])
    view = dataclasses.replace(scene.test[0], mask=torch.zeros_like(scene.test[0].image[0]))
    shown = pictures_of(model, view, ErrorMaps(model)(view, view.mask))
    assert "expected error" in shown
    assert shown["caption"] == ""


def test_the_models_are_those_of_the_runs(pair):
    runs, page = pair
    for run, packed in zip(runs, page.data["runs"], strict=True):
        model, scene = load_run_model(run)
        views = two_of_each(scene)
        shares = mean_shares(model, views)[0]
        values = share_per_weight(shares, blend_weights(model, views)).numpy()
        n, table = len(model.gaussians), unpacked(packed)
        order = Heat.of(model, views).ranks.argsort()
        assert (np.diff(values[order]) >= 0).all()
        gaussians = model.gaussians[order]
        np.testing.assert_allclose(table["means"], gaussians.means, rtol=1e-3, atol=2e-4 * packed["scale"])
        np.testing.assert_allclose(table["log_scales"], gaussians.log_scales, atol=0.011)
        expected = torch.nn.functional.normalize(gaussians.quaternions, dim=1)
        np.testing.assert_allclose(table["quaternions"], expected, atol=0.6 / 256)
        np.testing.assert_allclose(table["opacities"][:, 0], model.test_opacities[order], atol=0.6 / 512)
        bands = (packed["degree"] + 1) ** 2
        assert packed["degree"] == 2
        colors = table["sh"].reshape(n, bands, 3)
        np.testing.assert_allclose(colors[:, 0], gaussians.sh[:, 0], atol=0.6 / 128)
        np.testing.assert_allclose(colors[:, 1:], gaussians.sh[:, 1:bands], atol=0.6 / 36)
        held, tenth = packed["held"], order[-(n // 10) :]
        assert (held[0], held[100]) == (0, 1)
        assert held[10] == pytest.approx(shares.numpy()[tenth].sum() / shares.sum().item(), abs=1e-3)


def test_numbers_that_do_not_fit_their_step_get_a_larger_one():
    values = torch.tensor([[1e6, 0.25], [-1e6, -0.5], [3.0, 0.0]])
    packed = quantized([(values, 0.25)])
    assert packed["steps"] == [pytest.approx(1e6 / 32767)] * 2
    planes = zlib.decompress(b64decode(packed["text"]))
    assert list(planes[:3]) == [65534 % 256, 65533 % 256, 0]  # 32767 and -32767
    assert list(planes[3:6]) == [255, 255, 0]


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [0.9, 0.005])  # with a score, and too faint for one
def test_what_a_run_lacks_is_left_out_with_a_word(tmp_path, options, short, opacity):
    none = dataclasses.replace(options, test="none")
    unfinished(tmp_path / "mine", none, dataclasses.replace(short, initial_opacity=opacity))
    out = write_report([tmp_path / "mine"])
    assert out == tmp_path / "mine" / "report.html"
    page = Parsed(out)
    assert page.data["scores"] == []
    assert page.data["curves"] == []
    assert page.data["verdict"].startswith("No verdict")
    name = "Dropout 0.2 + noise 0.3"
    assert page.data["perView"] == {}
    notes = " ".join(page.data["notes"])
    assert f"{name}: no scores" in notes
    assert f"{name}: no CA and PSNR" in notes
    assert {view["name"].split()[0] for view in page.data["views"]} == {"between", "around", "train"}
    assert page.data["views"][0]["photograph"]  # nothing else can be compared with one
    for view in page.data["views"]:
        trained = view["name"].startswith("train")
        assert bool(view["photograph"]) == ("error" in view["pictures"][0]) == trained
        assert "render" in view["pictures"][0]
        assert ("co-adaptation" in view["pictures"][0]) == (opacity == 0.9)
    assert bool(page.data["attribution"]) == (opacity == 0.9)
    assert (f"{name}: no co-adaptation" in notes) == (opacity != 0.9)


def test_a_damaged_log_is_told_from_none(found, tmp_path, monkeypatch):
    runs = [trained(tmp_path / name, 0, 20.0, dropout=rate) for name, rate in (("damaged", 0.2), ("none", 0.3))]
    (runs[0] / LOG_NAME).write_text('{"step": "x"}\n')
    data = strategies(found, runs, tmp_path, monkeypatch)
    assert data["curves"] == []
    damaged, none = data["notes"][-2:]
    assert re.match(r"Dropout 0\.2: no CA and PSNR .*ca\.jsonl, line 1", damaged)
    assert re.match(r"Dropout 0\.3: no CA and PSNR .*nothing", none)


@pytest.mark.slow
def test_opacities_that_depend_on_the_camera_are_rendered_plain(tmp_path, options, short):
    config = dataclasses.replace(short, initial_opacity=0.9, regularizer="depth(0.4, scale=True)")
    trainer = unfinished(tmp_path, options, config)
    page = Parsed(write_report([tmp_path], views=1))
    assert "depend on the camera" in page.data["notes"][0]
    (packed,) = page.data["runs"]
    shown = np.sort(unpacked(packed)["opacities"][:, 0])
    np.testing.assert_allclose(shown, trainer.gaussians.opacities.detach().sort().values, atol=0.6 / 512)


def test_what_is_no_run_or_no_pair_is_refused(run, found, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="holds no run"):
        write_report([tmp_path])
    for runs in ([], [run[0], tmp_path, run[0]]):
        with pytest.raises(ValueError, match="at least 1 run"):
            write_report(runs)
    with pytest.raises(ValueError, match="at least 1 view"):
        write_report([run[0]], views=0)
    elsewhere = dataclasses.replace(found, scene=dataclasses.replace(found.scene, name="elsewhere"))
    shutil.copytree(run[0], tmp_path / "other")
    monkeypatch.setattr(page_module, "find", lambda folder, *_, **__: found if folder == run[0] else elsewhere)
    with pytest.raises(ValueError, match=r"one scene.*synthetic.*elsewhere"):
        write_report([run[0], tmp_path / "other"], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
    first, *others = found.scene.train  # a place of the same names
    moved = dataclasses.replace(first, camera=found.scene.test[0].camera)
    elsewhere = dataclasses.replace(found, scene=dataclasses.replace(found.scene, train=(moved, *others)))
    with pytest.raises(ValueError, match="other cameras"):
        write_report([run[0], tmp_path / "other"], tmp_path / "page.html")


def strategies(found, folders, tmp_path, monkeypatch) -> dict:
    """The data of a page about runs that all are plotted as one."""
    monkeypatch.setattr(page_module, "find", lambda _, label, **__: dataclasses.replace(found, label=label))
    return Parsed(write_report(folders, tmp_path / "page.html")).data


def test_strategies_of_one_name_are_told_apart_by_their_seeds(found, tmp_path, monkeypatch):
    runs = [
        trained(tmp_path / f"{name}/{seed}", seed, psnr + seed, dropout=0.2, iterations=iterations)
        for name, psnr, iterations in (("a", 20.0, 30), ("b", 22.0, 60), ("c", 24.0, 90))
        for seed in (0, 1)
    ]
    data = strategies(found, runs, tmp_path, monkeypatch)
    names = [f"Dropout 0.2 ({name}/0, {name}/1)" for name in "abc"]
    assert [(of["name"], of["seeds"]) for of in data["strategies"]] == [(name, 2) for name in names]
    assert data["verdict"].startswith(f"{names[2]} (")
    assert "4.00 dB higher PSNR" in data["verdict"]
    assert data["evidence"][0].startswith(f"{names[1]}: 2.00 dB higher PSNR")


def test_seeds_count_although_the_first_of_a_comparison_is_not_finished(found, tmp_path, monkeypatch):
    for seed in (0, 1, 2):
        trained(tmp_path / f"mine/seed_{seed}", seed, 20.0 + seed)
    (tmp_path / "mine/seed_0/results.json").unlink()
    data = strategies(found, [tmp_path], tmp_path, monkeypatch)
    assert [(of["name"], of["seeds"]) for of in data["strategies"]] == [("Baseline", 2)]
    assert data["scores"][0]["cells"][0]["text"] == "21.50 ± 0.71"


def test_text_from_files_cannot_end_the_data(run, found, tmp_path, monkeypatch):
    bad = "</script><script>alert(1)</script>"
    monkeypatch.setattr(page_module, "find", lambda *_, **__: dataclasses.replace(found, label=bad))
    monkeypatch.setattr(page_module, "unique_names", lambda *_: [bad])
    page = Parsed(write_report([run[0]], tmp_path / "page.html"))
    assert sum(tag == "script" for tag, _ in page.tags) == 2
    assert page.data["runs"][0]["label"] == bad


@pytest.mark.slow
def test_no_file_but_a_report_is_overwritten(run, tmp_path):
    (tmp_path / "thesis.html").write_text("<!doctype html>precious")
    with pytest.raises(ValueError, match=r"thesis\.html .*not overwritten"):
        write_report([run[0]], tmp_path / "thesis.html")
    assert (tmp_path / "thesis.html").read_text() == "<!doctype html>precious"
    for _ in range(2):  # its own page may be written again
        write_report([run[0]], tmp_path / "mine.html", views=1)


@pytest.mark.slow
def test_a_comparison_stands_for_the_first_seed_of_each_strategy(run, tmp_path):
    for name, seeds in (("dropout", (2, 10)), ("baseline", (0, 1))):
        for seed in seeds:
            shutil.copytree(run[0], tmp_path / name / f"seed_{seed}")
    write_json(tmp_path / "comparison.json", {"runs": {"baseline": [], "dropout": []}, "failures": {}})
    out = write_report([tmp_path], views=1)
    assert out == tmp_path / "report.html"
    labels = [each["label"] for each in Parsed(out).data["runs"]]
    assert labels == [f"Dropout 0.2 + noise 0.3 ({name})" for name in ("baseline/seed_0", "dropout/seed_2")]


@pytest.mark.slow
def test_the_scores_of_a_comparison_are_those_of_all_its_seeds(run, tmp_path):
    settings, results = (json.loads((run[0] / name).read_text()) for name in (CONFIG, "results.json"))
    for name, dropout, noise, psnr in (("mine", 0.2, 0.0, (20.0, 22.0)), ("baseline", 0.0, 0.0, (19.0, 20.0))):
        for seed, value in enumerate(psnr):
            folder = tmp_path / name / f"seed_{seed}"
            shutil.copytree(run[0], folder)
            changed = {"seed": seed, "dropout": dropout, "noise": noise}
            config = settings["config"] | changed
            write_json(folder / CONFIG, settings | {"config": config})
            state = torch.load(folder / CHECKPOINT, weights_only=True)
            torch.save(state | {"config": json.dumps(config)}, folder / CHECKPOINT)
            means = results["mean"] | {"test": results["mean"]["test"] | {"psnr": value}}
            write_json(folder / "results.json", results | {"config": config, "mean": means})
    data = Parsed(write_report([tmp_path], views=1)).data
    assert [each["label"] for each in data["runs"]] == ["Baseline", "Dropout 0.2"]
    assert [(of["name"], of["seeds"]) for of in data["strategies"]] == [("Baseline", 2), ("Dropout 0.2", 2)]
    cells = data["scores"][0]["cells"]
    assert [cell["text"] for cell in cells] == ["19.50 ± 0.71", "21.00 ± 1.41"]
    assert (cells[1]["delta"], cells[1]["better"], cells[1]["best"], cells[0]["best"]) == ("+1.50", True, True, False)
    # Two standard errors are 2 sqrt(0.5 / 2 + 2 / 2) = 2.24.
    assert re.match(r"Dropout 0\.2: a PSNR .*\(1\.50 dB higher\)", data["verdict"])


def trained(folder: Path, seed: int, psnr: float, *, test=("test_0",), train="train_0", **settings) -> Path:
    """The folder of a run with these scores."""
    config = TrainConfig(seed=seed, **settings)
    views = [{"name": name, "split": "test"} for name in test] + [{"name": train, "split": "train"}]
    views.append({"name": "000", "split": "between"})
    mean = {"test": {"psnr": psnr}, "train": {"psnr": psnr + 9}, "between": {"ca_exact_half": 0.004}}
    results = {"scene": "fern", "config": dataclasses.asdict(config), "seconds": 1.0, "gaussians": 7, "mean": mean}
    write_json(folder / CONFIG, run_settings(SceneOptions(), config))
    write_json(folder / "results.json", results | {"views": views})
    return folder


def test_two_trainings_side_by_side(tmp_path, capsys):
    for seed, psnr in enumerate((20.0, 20.1, 20.2)):
        trained(tmp_path / f"plain/seed_{seed}", seed, psnr)
        trained(tmp_path / f"dropout/seed_{seed}", seed, psnr + 1, dropout=0.2, iterations=99)
    (tmp_path / "plain/seed_2/results.json").rename(tmp_path / "later")  # not finished yet
    main(["diff", str(tmp_path / "plain"), str(tmp_path / "dropout")])
    said = capsys.readouterr().out
    assert "| test PSNR (dB) | 20.05 ± 0.07 | 21.10 ± 0.10 | +1.05 | unknown |" in said
    assert "Seeds: 2 and 3; too few" in said
    assert "differ in iterations" in said
    (tmp_path / "later").rename(tmp_path / "plain/seed_2/results.json")
    main(["diff", str(tmp_path / "plain"), str(tmp_path / "dropout")])
    assert "| 20.10 ± 0.10 | 21.10 ± 0.10 | +1.00 ± 0.16 | yes, better |" in capsys.readouterr().out

    other = trained(tmp_path / "other", 0, 25.0, test=("test_1",))
    rows, notes = compare_two(tmp_path / "plain/seed_0", other)
    assert not any(str(row["score"]).startswith("test") for row in rows)
    assert any("not compared" in note.lower() and "test" in note for note in notes)
    other = trained(tmp_path / "elsewhere", 0, 25.0, train="train_1")  # and between other cameras, of the same numbers
    rows, _ = compare_two(tmp_path / "plain/seed_0", other)
    assert {str(row["score"]).split()[0] for row in rows} == {"test", "Gaussians", "seconds"}


def test_what_cannot_be_compared_is_refused(tmp_path):
    run, seeds = trained(tmp_path / "run", 0, 20.0), tmp_path / "seeds"
    with pytest.raises(ValueError, match="two different runs"):
        compare_two(run, run)
    with pytest.raises(FileNotFoundError, match="holds no run"):
        compare_two(run, tmp_path)
    trained(seeds / "seed_0", 0, 20.0)
    trained(seeds / "seed_1", 1, 20.0, dropout=0.1)
    with pytest.raises(ValueError, match="more than the seed"):
        compare_two(run, seeds)
    trained(seeds / "seed_1", 1, 20.0, test=("test_0", "test_1"))  # of a photograph that came later
    with pytest.raises(ValueError, match="same views"):
        compare_two(run, seeds)
    (seeds / "seed_0/results.json").unlink()
    (seeds / "seed_1/results.json").unlink()
    with pytest.raises(ValueError, match="no scores yet"):
        compare_two(run, seeds)
