import dataclasses
import json
import os
import re
import shutil
import zlib
from base64 import b64decode
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Page
from heard import hearing
from PIL import Image

from ca_reg.monitor import LOG_NAME, read_dynamics
from reference_trainer.cli import main
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import Heat, blend_weights, colored_by, mean_shares, share_per_weight
from reference_trainer.evaluation.style import STRATEGIES
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.report import page as page_module
from reference_trainer.report.findings import find
from reference_trainer.report.packing import quantized
from reference_trainer.report.page import compare_two, write_report
from reference_trainer.runs.folder import CHECKPOINT, CONFIG, run_settings
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


class Parsed(HTMLParser):
    """A page: its tags with their attributes, and the texts inside of them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.texts, self._open = dict[str, str](), ""
        self.text = path.read_text("utf-8")
        self.feed(self.text)
        self.data = json.loads(self.texts["data"], parse_constant=pytest.fail)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._open = dict(attributes).get("id", tag)

    def handle_data(self, text):
        self.texts[self._open] = self.texts.get(self._open, "") + text


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


def two_of_each(scene: Scene) -> list[View]:
    """The views of a page that shows two of each split."""
    return [scene.test[0], scene.test[-1], scene.train[0], scene.train[-1]]


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
        assert (column["split"], column["title"]) == ("test", "PSNR")
        assert column["cells"][i]["text"] == f"{results['mean']['test']['psnr']:.2f}"
        assert f"{name}: 11 steps with dropout(0.2) + noise(0.3" in " ".join(page.data["about"])
        assert f"| {name} | " in page.data["attribution"]
    assert "ca-reg report " in page.data["made"]
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
    assert [note for note in page.data["notes"] if "against the step" in note] == [
        f"{without}: no CA and PSNR against the step, because nothing was measured while it trained."
    ]


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
                drawn = np.asarray(file).transpose(2, 0, 1) / 255
            assert np.abs(drawn - expected.clamp(0, 1).numpy()).mean() < 0.02  # a JPEG
        assert set(entry["pictures"][1]) == {"render", "error", "co-adaptation", "caption"}


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
        np.testing.assert_allclose(colors[:, 0], gaussians.sh[:, 0], atol=0.6 / 256)
        np.testing.assert_allclose(colors[:, 1:], gaussians.sh[:, 1:bands], atol=0.6 / 40)
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


def unfinished(folder: Path, options: SceneOptions, config: TrainConfig) -> Trainer:
    """Train a run for some steps and leave it."""
    trainer = Trainer(load_scene(options), config)
    trainer.train(until=4)
    trainer.save(folder / CHECKPOINT)
    write_json(folder / CONFIG, run_settings(options, config))
    return trainer


@pytest.mark.parametrize("opacity", [0.9, 0.005])  # with a score, and too faint for one
def test_what_a_run_lacks_is_left_out_with_a_word(tmp_path, options, short, opacity):
    none = dataclasses.replace(options, test="none")
    unfinished(tmp_path / "mine", none, dataclasses.replace(short, initial_opacity=opacity))
    out = write_report([tmp_path / "mine"])
    assert out == tmp_path / "mine" / "report.html"
    page = Parsed(out)
    assert page.data["scores"] == []
    assert page.data["curves"] == []
    assert page.data["verdict"] == "No verdict: no run has been trained to its end."
    name = "Dropout 0.2 + noise 0.3"
    assert page.data["perView"] == {}
    notes = " ".join(page.data["notes"])
    assert f"{name}: no scores, it has not been trained to its end." in notes
    assert f"{name}: no CA and PSNR against the step" in notes
    assert {view["name"].split()[0] for view in page.data["views"]} == {"between", "around", "train"}
    assert page.data["views"][0]["photograph"]  # nothing else can be compared with one
    for view in page.data["views"]:
        trained = view["name"].startswith("train")
        assert bool(view["photograph"]) == ("error" in view["pictures"][0]) == trained
        assert "render" in view["pictures"][0]
        assert ("co-adaptation" in view["pictures"][0]) == (opacity == 0.9)
    assert bool(page.data["attribution"]) == (opacity == 0.9)
    assert (f"{name}: no co-adaptation: none of the" in notes) == (opacity != 0.9)


def test_a_damaged_log_is_told_from_none(tmp_path):
    for name, content in (("damaged", '{"step": "x"}\n'), ("none", None)):
        (tmp_path / name).mkdir()
        if content:
            (tmp_path / name / LOG_NAME).write_text(content)
    curves, notes = page_module._curves({name: tmp_path / name for name in ("damaged", "none")})
    assert curves == []
    assert re.match(r"damaged: no CA and PSNR against the step: .*ca\.jsonl, line 1, is no measurement ", notes[0])
    assert notes[1] == "none: no CA and PSNR against the step, because nothing was measured while it trained."


def test_opacities_that_depend_on_the_camera_are_drawn_plain(tmp_path, options, short):
    config = dataclasses.replace(short, initial_opacity=0.9, regularizer="depth(0.4, scale=True)")
    trainer = unfinished(tmp_path, options, config)
    page = Parsed(write_report([tmp_path], views=1))
    assert "opacities depend on the camera" in page.data["notes"][0]
    (packed,) = page.data["runs"]
    drawn = np.sort(unpacked(packed)["opacities"][:, 0])
    np.testing.assert_allclose(drawn, trainer.gaussians.opacities.detach().sort().values, atol=0.6 / 512)


def test_what_is_no_run_or_no_pair_is_refused(run, found, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="holds no run"):
        write_report([tmp_path])
    for runs in ([], [run[0], tmp_path, run[0]]):
        with pytest.raises(ValueError, match="at least 1 run, each once"):
            write_report(runs)
    with pytest.raises(ValueError, match="at least 1 view"):
        write_report([run[0]], views=0)
    elsewhere = dataclasses.replace(found, scene=dataclasses.replace(found.scene, name="elsewhere"))
    shutil.copytree(run[0], tmp_path / "other")
    monkeypatch.setattr(page_module, "find", lambda folder, *_, **__: found if folder == run[0] else elsewhere)
    with pytest.raises(ValueError, match=r"a report is about one scene.*synthetic.*elsewhere"):
        write_report([run[0], tmp_path / "other"], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_text_from_files_cannot_end_the_data(run, found, tmp_path, monkeypatch):
    bad = "</script><script>alert(1)</script>"
    monkeypatch.setattr(page_module, "find", lambda *_, **__: dataclasses.replace(found, label=bad))
    monkeypatch.setattr(page_module, "unique_names", lambda *_: [bad])
    page = Parsed(write_report([run[0]], tmp_path / "page.html"))
    assert sum(tag == "script" for tag, _ in page.tags) == 2
    assert page.data["runs"][0]["label"] == bad


# In a browser.

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")


@pytest.fixture(scope="module")
def turned(tmp_path_factory, short):
    """Two runs with ellipsoids of all shapes, in colors that depend on the direction, and the page about both."""
    folder = tmp_path_factory.mktemp("turned")
    options, runs = SceneOptions("synthetic", downscale=2), [folder / "baseline", folder / "dropout"]
    spreads = {"sh_rest": 0.2, "log_scales": 0.7, "quaternions": 1.0, "opacity_logits": 2.0}
    units, groups = (("ca", 5e-3), ("psnr", 30.0)), ("train", "test")
    for run, rate in zip(runs, (0.0, 0.2), strict=True):
        trainer = unfinished(run, options, dataclasses.replace(short, dropout=rate, sh_every=1, initial_opacity=0.9))
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for name, spread in spreads.items():
                part = getattr(trainer.gaussians, name)
                part += spread * torch.randn(part.shape, generator=generator)
            trainer.gaussians.log_scales[::2] -= 2.0  # some are as thin as a pixel
        trainer.save(run / CHECKPOINT)
        lines = [
            {"step": step, "method": "exact", "drop_rate": 0.5}
            | {
                f"{key}/{group}": torch.rand((), generator=generator).item() * unit
                for key, unit in units
                for group in groups
            }
            for step in (100, 200, 300, 400)
        ]
        (run / LOG_NAME).write_text("".join(json.dumps(line) + "\n" for line in lines))
    return runs, write_report(runs, views=2)


@pytest.fixture(scope="module")
def opened(turned):
    """The page in a browser."""
    with Page(turned[1]) as page:
        page.run("ready.then(() => 0)")
        page.run("for (const { canvas } of models) canvas.style.width = '80px'")  # as the photographs
        yield page


def shown(page: Page, script: str) -> list[np.ndarray]:
    """Run a script; return what every canvas shows after it, (3, H, W) in [0, 1]."""
    pictures = []
    for uri in page.run(f"{script}; draw(); models.map(model => model.canvas.toDataURL())"):
        with Image.open(BytesIO(b64decode(uri.partition(",")[2]))) as file:
            pictures.append(np.asarray(file.convert("RGB")).transpose(2, 0, 1) / 255)
    return pictures


def assert_drawn(picture: np.ndarray, model: TrainedModel, view: View) -> None:
    """A browser's picture is what the renderer draws, but for the roundings: every blend is rounded to 8 bits."""
    expected = model.test_rendering(view).image.clamp(0, 1).numpy()
    assert expected.mean() > 0.1
    error = np.abs(picture - expected) * 255
    assert error.mean() < 1.5
    assert np.quantile(error, 0.99) < 8


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_what_the_renderer_draws(turned, opened):
    runs, _ = turned
    found = [load_run_model(run) for run in runs]
    for number, view in enumerate(two_of_each(found[0][1])):
        drawn = shown(opened, f"$('from').value = {number}; $('from').onchange()")
        for (model, _), picture in zip(found, drawn, strict=True):
            assert_drawn(picture, model, view)


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_the_heat_and_hides_what_co_adapts_most(turned, opened):
    runs, path = turned
    data, found = Parsed(path).data, [load_run_model(run) for run in runs]
    views = two_of_each(found[0][1])
    low, high = (float(end) for end in data["ends"]["heat"])
    plain = shown(opened, "$('from').value = 0; $('from').onchange(); $('color').click()")
    for hidden in (0, 30):
        drawn = shown(opened, f"$('heat').click(); $('hide').value = {hidden}")
        for (model, _), picture, color in zip(found, drawn, plain, strict=True):
            values = share_per_weight(mean_shares(model, views)[0], blend_weights(model, views))
            kept = values.argsort().argsort() < len(values) - len(values) * hidden // 100
            assert int(kept.sum()) == pytest.approx((1 - hidden / 100) * len(values), abs=1)
            heat = colored_by(model.gaussians, values, low, high)[kept]
            assert_drawn(picture, dataclasses.replace(model, gaussians=heat), views[0])
            assert np.abs(picture - color).mean() > 0.1
    text = opened.run("document.getElementById('models').textContent")
    assert f"{100 * data['runs'][1]['held'][30]:.1f} % of the co-adaptation" in text
    shown(opened, "$('color').click(); $('hide').value = 0")


@pytest.mark.slow
@needs_browser
def test_a_drag_turns_all_models_about_one_point(turned, opened):
    before = shown(opened, "$('from').value = 0; $('from').onchange()")
    at = opened.run(
        "models[1].canvas.scrollIntoView(); (({ x, y }) => ({ x, y }))(models[1].canvas.getBoundingClientRect())"
    )
    start = {"x": at["x"] + 20, "y": at["y"] + 20}
    opened("Input.dispatchMouseEvent", type="mousePressed", button="left", **start)
    moved = {"x": start["x"] + 40, "y": start["y"] - 15}
    opened("Input.dispatchMouseEvent", type="mouseMoved", button="left", buttons=1, **moved)
    opened("Input.dispatchMouseEvent", type="mouseReleased", button="left", **moved)
    for picture, after in zip(before, shown(opened, ""), strict=True):
        assert np.abs(picture - after).mean() > 0.02
    state = opened.run("({ ...camera, depth })")
    rotation, shift = np.array(state["rotation"]).reshape(3, 3), np.array(state["translation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    pose = np.array(Parsed(turned[1]).data["views"][0]["pose"]).reshape(3, 4)
    point = pose[:, :3].T @ (np.array([0, 0, state["depth"]]) - pose[:, 3])
    np.testing.assert_allclose(rotation @ point + shift, [0, 0, state["depth"]], atol=1e-5)
    angle = np.arccos((np.trace(rotation @ pose[:, :3].T) - 1) / 2)
    assert angle == pytest.approx(np.hypot(40, 15) / 200, rel=0.01)  # two small turns, one after the other


@pytest.mark.slow
@needs_browser
def test_any_two_pictures_are_wiped_flickered_and_enlarged(turned, opened):
    view = Parsed(turned[1]).data["views"][0]
    assert opened.run("[$('left').value, $('right').value]") == ["photograph", "render"]
    images = "[...document.querySelectorAll('#views .stack')].slice(0, 2).map(box => [...box.children].slice(0, 2)"
    sources, clip = f"{images}.map(image => image.src))", f"{images}.map(image => image.style.clipPath))"
    expected = [[view["photograph"], view["pictures"][run]["render"]] for run in (0, 1)]
    assert opened.run(sources) == expected
    assert opened.run(f"$('wipe').value = 30; $('wipe').oninput(); {clip}")[0][1] == "inset(0px 0px 0px 30%)"
    # Each run's CA map against the render of the second.
    opened.run("$('left').value = 'co-adaptation'; $('right').value = 'render/1'; $('left').oninput()")
    expected = [[view["pictures"][run]["co-adaptation"], view["pictures"][1]["render"]] for run in (0, 1)]
    assert opened.run(sources) == expected
    turns = f"$('flicker').click(), new Promise(done => setTimeout(() => done({clip}[0][1]), 900))"
    assert opened.run(turns) == "inset(0px 0px 0px 0%)"  # after one turn the right picture covers the left
    assert opened.run(f"$('flicker').click(); {clip}")[0][1] == "inset(0px 0px 0px 30%)"
    opened.run("stacks[1].box.focus()")
    for key in ("Enter", "PageDown"):
        opened("Input.dispatchKeyEvent", type="keyDown", key=key, text="\r" if key == "Enter" else "")
        opened("Input.dispatchKeyEvent", type="keyUp", key=key)
    assert opened.run("[$('large').open, $('which').textContent.split(' · ')[1], document.activeElement.id]") == [
        True, Parsed(turned[1]).data["views"][1]["name"], "wide",
    ]  # fmt: skip
    opened.run("$('close').click()")


@pytest.mark.slow
@needs_browser
def test_the_models_move_by_keys_and_along_the_flight_and_are_reset(turned, opened):
    flight, state = Parsed(turned[1]).data["flight"], "JSON.stringify(camera)"
    before = opened.run(f"$('reset').click(); {state}")
    key = "models[0].canvas.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{}' }}))"
    for name in ("ArrowLeft", "+"):
        assert (after := opened.run(f"{key.format(name)}; {state}")) != before
        assert opened.run(f"$('reset').click(); {state}") == before != after
    moved = "new Promise(done => setTimeout(() => { $('play').click(); done([...camera.rotation]) }, 300))"
    rotation = opened.run(f"$('play').click(), {moved}")
    assert any(np.allclose(np.array(pose).reshape(3, 4)[:, :3].flatten(), rotation) for pose in flight)
    assert opened.run(f"$('reset').click(); {state}") == before


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("width", [360, 1200, 2560])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_its_window_in_light_and_dark(turned, width, scheme):
    with Page(turned[1], width=width) as page:
        page.run("ready.then(() => 0)")
        page("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        page.run("document.querySelectorAll('details').forEach(part => { part.open = true; })")
        assert page.run("document.documentElement.scrollWidth") == width
        corner = page.picture()[:, :5, :5].mean()
        assert corner < 0.2 if scheme == "dark" else corner > 0.9
        first, second = page.run("models.map(({ canvas }) => canvas.getBoundingClientRect().toJSON())")
        assert (second["top"] > first["top"]) == (width < 700)  # stacked
        hint = page.run("document.querySelector('.hint').focus(); hint.ariaDescription")
        tip = page.run("[$('tip').hidden, $('tip').textContent, $('tip').getBoundingClientRect().right]")
        assert tip[:2] == [False, hint]
        assert tip[2] <= width


@pytest.mark.slow
@needs_browser
def test_curves_are_read_zoomed_and_toggled(turned, opened):
    curves = Parsed(turned[1]).data["curves"]
    steps, [first, *_] = curves[0]["step"], sorted({(curve["run"], curve["group"]) for curve in curves})
    opened.run("charts[0].box.scrollIntoView()")
    box = opened.run("charts[0].box.getBoundingClientRect().toJSON()")
    left, right = 42, 10  # of the axes
    places = [
        box["x"] + left + (step - steps[0]) / (steps[-1] - steps[0]) * (box["width"] - left - right) for step in steps
    ]

    def mouse(kind, x, **rest):
        opened("Input.dispatchMouseEvent", type=kind, x=x, y=box["y"] + 50, button="left", **rest)

    mouse("mouseMoved", places[1] + 3)  # near the second step
    text = opened.run("$('readout').textContent")
    for curve in curves:
        ca, psnr = curve["ca"][1], curve["psnr"][1]
        assert f"{curve['run']}, {curve['group']}: CA {ca:.2f}, PSNR {psnr:.2f}" in text
    mouse("mousePressed", places[1])
    mouse("mouseMoved", places[-1], buttons=1)
    mouse("mouseReleased", places[-1])
    assert opened.run("range") == [steps[1], steps[-1]]
    assert opened.run("$('zoomed').click(), range") == [steps[0], steps[-1]]
    paths = "charts.map(({ box }) => box.querySelectorAll('.curve').length)"
    assert opened.run(paths) == [len(curves)] * 2
    for toggle, left_over in (
        (first[0], [curve for curve in curves if curve["run"] != first[0]]),
        ("test", [curve for curve in curves if curve["group"] != "test"]),
    ):
        button = f"[...document.querySelectorAll('.toggle')].find(x => x.textContent === {json.dumps(toggle)})"
        assert opened.run(f"{button}.click(), {paths}") == [len(left_over)] * 2
        assert opened.run(f"{button}.ariaPressed") == "false"
        assert opened.run(f"{button}.click(), {paths}") == [len(curves)] * 2
    colors = {run["label"]: run["color"] for run in Parsed(turned[1]).data["runs"]}
    assert [*colors.values()] == [STRATEGIES["noise"], STRATEGIES["both"]]
    drawn = opened.run("[...charts[0].box.querySelectorAll('.curve')].map(path => path.getAttribute('stroke'))")
    assert drawn == [colors[curve["run"]] for curve in curves]


@pytest.mark.slow
@needs_browser
@pytest.mark.skipif("CA_REG_AXE" not in os.environ, reason="needs the axe.min.js of npm pack axe-core in $CA_REG_AXE")
@pytest.mark.parametrize("width", [360, 1200, 2560])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_people_of_all_abilities_can_use_the_page(turned, width, scheme):
    with Page(turned[1], width=width) as page:
        page("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        page.run("ready.then(() => 0)")
        page.run("document.querySelectorAll('details').forEach(part => { part.open = true; })")
        page.run(Path(os.environ["CA_REG_AXE"]).read_text("utf-8") + "; 0")
        found = page.run("axe.run({ resultTypes: ['violations'] })")
        assert len(found["passes"]) > 20
        assert not [
            f"{of['id']}: {of['nodes'][0]['html']} {of['nodes'][0]['failureSummary']}" for of in found["violations"]
        ]


@pytest.mark.slow
@needs_browser
def test_no_request_leaves_the_page(turned, opened):
    assert opened.requests[0] == turned[1].as_uri()
    assert all(address.startswith("data:") for address in opened.requests[1:])
    assert not opened.complaints


def test_no_file_but_a_report_is_overwritten(run, tmp_path):
    (tmp_path / "thesis.html").write_text("<!doctype html>precious")
    with pytest.raises(ValueError, match=r"thesis\.html is no report of ca-reg and is not overwritten"):
        write_report([run[0]], tmp_path / "thesis.html")
    assert (tmp_path / "thesis.html").read_text() == "<!doctype html>precious"
    for _ in range(2):  # its own page may be written again
        write_report([run[0]], tmp_path / "mine.html", views=1)


def test_a_comparison_stands_for_the_first_seed_of_each_strategy(run, tmp_path):
    for name, seeds in (("dropout", (2, 10)), ("baseline", (0, 1))):
        for seed in seeds:
            shutil.copytree(run[0], tmp_path / name / f"seed_{seed}")
    write_json(tmp_path / "comparison.json", {"runs": {"baseline": [], "dropout": []}, "failures": {}})
    out = write_report([tmp_path], views=1)
    assert out == tmp_path / "report.html"
    labels = [each["label"] for each in Parsed(out).data["runs"]]
    assert labels == [f"Dropout 0.2 + noise 0.3 ({name})" for name in ("baseline/seed_0", "dropout/seed_2")]


def test_the_scores_of_a_comparison_are_those_of_all_its_seeds(run, tmp_path):
    settings, results = (json.loads((run[0] / name).read_text()) for name in (CONFIG, "results.json"))
    for name, dropout, noise, psnr in (("mine", 0.2, 0.0, (20.0, 22.0)), ("baseline", 0.0, 0.0, (19.0, 20.0))):
        for seed, value in enumerate(psnr):
            folder = tmp_path / name / f"seed_{seed}"
            shutil.copytree(run[0], folder)
            changed = {"seed": seed, "dropout": dropout, "noise": noise}
            write_json(folder / CONFIG, settings | {"config": settings["config"] | changed})
            means = results["mean"] | {"test": results["mean"]["test"] | {"psnr": value}}
            write_json(folder / "results.json", results | {"config": results["config"] | changed, "mean": means})
    data = Parsed(write_report([tmp_path], views=1)).data
    assert [each["label"] for each in data["runs"]] == ["Baseline", "Dropout 0.2"]
    assert [(of["name"], of["seeds"]) for of in data["strategies"]] == [("Baseline", 2), ("Dropout 0.2", 2)]
    cells = data["scores"][0]["cells"]
    assert [cell["text"] for cell in cells] == ["19.50 ± 0.71", "21.00 ± 1.41"]
    assert (cells[1]["delta"], cells[1]["better"], cells[1]["best"], cells[0]["best"]) == ("+1.50", True, True, False)
    # Two standard errors are 2 sqrt(0.5 / 2 + 2 / 2) = 2.24.
    assert data["verdict"].startswith("Dropout 0.2: a PSNR that cannot be told apart (+1.50 dB) and ")


def trained(folder: Path, seed: int, psnr: float, *, test=("test_0",), **settings) -> Path:
    """The folder of a run with these scores."""
    config = TrainConfig(seed=seed, **settings)
    views = [{"name": name, "split": "test"} for name in test] + [{"name": "train_0", "split": "train"}]
    mean = {"test": {"psnr": psnr}, "train": {"psnr": psnr + 9}}
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
    assert "| test PSNR | 20.05 ± 0.07 | 21.10 ± 0.10 | +1.05 | unknown |" in said
    assert "Seeds: 2 and 3; too few" in said
    assert "differ in iterations" in said
    (tmp_path / "later").rename(tmp_path / "plain/seed_2/results.json")
    main(["diff", str(tmp_path / "plain"), str(tmp_path / "dropout")])
    assert "| test PSNR | 20.10 ± 0.10 | 21.10 ± 0.10 | +1.00 ± 0.16 | yes, better |" in capsys.readouterr().out

    other = trained(tmp_path / "other", 0, 25.0, test=("test_1",))
    rows, notes = compare_two(tmp_path / "plain/seed_0", other)
    assert not any(str(row["score"]).startswith("test") for row in rows)
    assert any("not compared" in note.lower() and "test" in note for note in notes)


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
    (seeds / "seed_0/results.json").unlink()
    (seeds / "seed_1/results.json").unlink()
    with pytest.raises(ValueError, match="no scores yet"):
        compare_two(run, seeds)
