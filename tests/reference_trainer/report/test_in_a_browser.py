"""The page of `ca-reg report` in headless Chromium: pictures, models, curves, keys, widths, accessibility."""

import dataclasses
import json
import os
from base64 import b64decode
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Page
from PIL import Image
from reports import Parsed, needs_browser, two_of_each, unfinished

from ca_reg.monitor import LOG_NAME
from reference_trainer.evaluation.shares import blend_weights, colored_by, mean_shares, share_per_weight
from reference_trainer.evaluation.style import STRATEGIES
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.report.page import write_report
from reference_trainer.runs.folder import CHECKPOINT
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View


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


def assert_rendered(picture: np.ndarray, model: TrainedModel, view: View) -> None:
    """A browser's picture is what the renderer renders, but for the roundings: every blend is rounded to 8 bits."""
    expected = model.test_rendering(view).image.clamp(0, 1).numpy()
    assert expected.mean() > 0.1
    error = np.abs(picture - expected) * 255
    assert error.mean() < 1.5
    assert np.quantile(error, 0.99) < 8


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_what_the_renderer_renders(turned, opened):
    runs, _ = turned
    found = [load_run_model(run) for run in runs]
    for number, view in enumerate(two_of_each(found[0][1])):
        pictures = shown(opened, f"$('from').value = {number}; $('from').onchange()")
        for (model, _), picture in zip(found, pictures, strict=True):
            assert_rendered(picture, model, view)


@pytest.mark.slow
@needs_browser
def test_a_browser_shows_the_heat_and_hides_what_co_adapts_most(turned, opened):
    runs, path = turned
    data, found = Parsed(path).data, [load_run_model(run) for run in runs]
    views = two_of_each(found[0][1])
    low, high = (float(end) for end in data["ends"]["heat"])
    plain = shown(opened, "$('from').value = 0; $('from').onchange(); $('color').click()")
    for hidden in (0, 30):
        pictures = shown(opened, f"$('heat').click(); $('hide').value = {hidden}")
        for (model, _), picture, color in zip(found, pictures, plain, strict=True):
            values = share_per_weight(mean_shares(model, views)[0], blend_weights(model, views))
            kept = values.argsort().argsort() < len(values) - len(values) * hidden // 100
            assert int(kept.sum()) == pytest.approx((1 - hidden / 100) * len(values), abs=1)
            heat = colored_by(model.gaussians, values, low, high)[kept]
            assert_rendered(picture, dataclasses.replace(model, gaussians=heat), views[0])
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
def test_on_paper_all_pictures_of_a_view_stand_beside_each_other(turned, opened):
    data = Parsed(turned[1]).data
    kinds = "photograph", "render", "error", "expected error", "co-adaptation"
    expected = [
        [source for kind in kinds if (source := ({"photograph": view["photograph"]} | pictures).get(kind))]
        for view in data["views"]
        for pictures in view["pictures"]
    ]
    assert len(expected[0]) >= 4
    opened("Emulation.setEmulatedMedia", media="print")
    sheets = "[...document.querySelectorAll('#views .sheet')].map(sheet => [...sheet.querySelectorAll('img')]"
    on_paper = opened.run(f"dispatchEvent(new Event('beforeprint')), {sheets}.map(image => image.src))")
    assert on_paper == expected
    assert opened.run(f"{sheets}.every(image => image.clientWidth > 50)).every(Boolean)")
    assert opened.run("stacks.filter(({ box }) => box.clientWidth).every(({ kinds }) => kinds)")  # none that is wiped
    opened.run("dispatchEvent(new Event('afterprint'))")
    opened("Emulation.setEmulatedMedia", media="")
    assert opened.run("document.querySelectorAll('.sheet').length") == 0
    assert opened.run("stacks.every(({ box }) => box.clientWidth)")


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
        half = "[...document.querySelectorAll('.hint')].find(x => x.textContent === 'half is held by').ariaDescription"
        assert "fewest Gaussians" in page.run(half)  # a share of them, not of the score
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
    plotted = opened.run("[...charts[0].box.querySelectorAll('.curve')].map(path => path.getAttribute('stroke'))")
    assert plotted == [colors[curve["run"]] for curve in curves]


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
