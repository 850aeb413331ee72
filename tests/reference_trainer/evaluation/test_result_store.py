"""An interrupted measurement continues, and only with what belongs to it."""

import dataclasses
import json
import math

import pytest
import torch

from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.results import ResultStore, fingerprint
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.scenes.scene import Viewpoint


@pytest.fixture(scope="module")
def model(tiny_scene):
    points = tiny_scene.points
    sizes = torch.full((len(points.positions),), 0.1)
    return TrainedModel(
        Gaussians.from_points(points.positions, points.colors, sizes, sh_degree=0, opacity=0.9), tiny_scene.background
    )


def test_records_come_back_as_they_were(tmp_path, said):
    file = tmp_path / "a" / "kept.json"
    records = {"one": {"x": 0.1 + 0.2, "n": 3, "name": "\udc80 ä"}, "two": {"x": math.inf, "y": -0.0}}
    kept = ResultStore(file, "as before")
    for key, record in records.items():
        assert kept.get(key) is None
        kept.add(key, record)
    kept.add("three", {"x": math.nan})
    assert said == []
    again = ResultStore(file, "as before")
    assert {key: again.get(key) for key in records} == records
    assert math.isnan(again.get("three")["x"])
    assert said == [f"3 measured before, kept: {file}"]


def test_a_record_whose_picture_is_gone_is_not_used(tmp_path):
    kept = ResultStore(tmp_path / "kept.json", None)
    (tmp_path / "picture.png").touch()
    kept.add("view", {"x": 1.0})
    assert kept.get("view", [tmp_path / "picture.png"]) == {"x": 1.0}
    assert kept.get("view", [tmp_path / "picture.png", tmp_path / "panel.png"]) is None


def test_records_of_something_else_are_gone_before_anything_is_measured(tmp_path, said):
    file = tmp_path / "kept.json"
    ResultStore(file, {"seed": 0}).add("view", {"x": 1.0})
    assert ResultStore(file, {"seed": 1}).get("view") is None
    (text,) = said
    assert f"{file} are not used" in text
    assert "another model, scene, setting or machine" in text
    assert not file.exists()  # and not found again by the first setting, whose pictures are being replaced


def test_a_damaged_file_is_told_and_never_half_read(tmp_path, said):
    """Every byte in turn is changed, and the file cut at every byte."""
    file = tmp_path / "kept.json"
    expected = {"view": {"x": 1.25, "name": "a"}, "other": {"x": math.nan, "name": "b"}}
    kept = ResultStore(file, 0)
    for key, record in expected.items():
        kept.add(key, record)
    good = file.read_bytes()
    told = 0
    for at in range(len(good)):
        for damaged in (good[:at], good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :]):
            file.write_bytes(damaged)
            said.clear()
            found = ResultStore(file, 0)
            records = {key: found.get(key) for key in expected}
            if records == {"view": None, "other": None}:
                assert "are not used" in said[0]
                told += 1
            else:  # blanks between values may change
                assert json.dumps(records) == json.dumps(expected)
    assert told > 1.5 * len(good)


@pytest.mark.parametrize("content", ["[]", "null", "{}", '{"depends_on": 1, "digest": 2, "records": 3}'])
def test_another_json_file(tmp_path, content, said):
    (tmp_path / "kept.json").write_text(content)
    assert ResultStore(tmp_path / "kept.json", 0).get("view") is None
    assert "it is damaged" in said[0]


def test_nothing_is_kept_where_nobody_asked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = ResultStore(None, print)  # a fingerprint of a function would be a TypeError
    kept.add("view", {"x": 1.0})
    assert kept.get("view") is None
    assert list(tmp_path.iterdir()) == []


def test_a_fingerprint_tells_everything_apart():
    values = [
        *(None, 0, 0.0, -0.0, math.nan, True, "0", "", [], [[]], [0, 0], [[0], 0], [0, [0]], {"a": 0}, {"a": [0]}),
        *(torch.zeros(2), torch.zeros(2, 1), torch.zeros(1, 2), torch.zeros(4, dtype=torch.int16), torch.zeros(0)),
        *(torch.tensor(0.0), torch.tensor(-0.0), torch.zeros(2, dtype=torch.bfloat16), torch.ones(2)),
        *(TrainedModel(torch.zeros(1), torch.zeros(3), text) for text in ("", "dropout(0.1)")),
    ]
    digests = [fingerprint(x) for x in values]
    assert len(set(digests)) == len(digests)
    assert digests == [fingerprint(x) for x in values]
    assert fingerprint(torch.arange(6).reshape(2, 3).T) == fingerprint(torch.tensor([[0, 3], [1, 4], [2, 5]]))
    with pytest.raises(TypeError, match="got set"):
        fingerprint([{1}])


@pytest.mark.parametrize("done", [0, 1, 3])
def test_an_interrupted_evaluation_measures_the_rest(model, tiny_scene, tmp_path, done, said):
    views = {"train": tiny_scene.train, "around": [Viewpoint("000", tiny_scene.test[0].camera)]}
    file, pictures = tmp_path / "kept.json", tmp_path / "views"
    whole = evaluate(model, views, samples=2, pictures=tmp_path / "whole")
    begun = []

    def stop():
        if len(begun) == done:
            raise KeyboardInterrupt
        begun.append(None)

    with pytest.raises(KeyboardInterrupt):
        evaluate(model, views, samples=2, pictures=pictures, partial=file, on_view=stop)
    said.clear()
    assert repr(evaluate(model, views, samples=2, pictures=pictures, partial=file)) == repr(whole)
    assert sum(text.startswith("[") for text in said) == 4 - done
    names = sorted(path.relative_to(pictures) for path in pictures.rglob("*.png"))
    assert len(names) == 8
    assert all((pictures / name).read_bytes() == (tmp_path / "whole" / name).read_bytes() for name in names)


class Brightness:
    """A metric with a weight."""

    name = "brightness"

    def __init__(self, weight):
        self.weight = weight

    def __call__(self, image, target):
        return (self.weight * (image - target).abs().amax()).item()


def both(scene):
    return {"train": scene.train, "test": scene.test}


def changes(model, scene):
    brighter = dataclasses.replace(scene.test[0], image=scene.test[0].image * 0.5)
    moved = dataclasses.replace(model.gaussians, means=model.gaussians.means + 1e-6)
    return {
        "samples": (model, scene, {"samples": 3}),
        "seed": (model, scene, {"seed": 1}),
        "dropout": (dataclasses.replace(model, regularizer="dropout(0.1)"), scene, {}),
        "scale": (dataclasses.replace(model, regularizer="noise(0.1, scale=True)"), scene, {}),
        "background": (dataclasses.replace(model, background=model.background + 0.1), scene, {}),
        "model": (dataclasses.replace(model, gaussians=moved), scene, {}),
        "photograph": (model, dataclasses.replace(scene, test=(brighter, *scene.test[1:])), {}),
        "views": (model, dataclasses.replace(scene, train=scene.train[:-1]), {}),
        "metric": (model, scene, {"perceptual": Brightness(1.0)}),
        "weights": (model, scene, {"perceptual": Brightness(2.0)}),
    }


@pytest.mark.parametrize(
    "name",
    ["samples", "seed", "dropout", "scale", "background", "model", "photograph", "views", "metric", "weights"],
)
def test_what_changed_is_not_mixed_with_what_was_measured(model, tiny_scene, tmp_path, name, said):
    scene = dataclasses.replace(tiny_scene, train=tiny_scene.train[:2], test=tiny_scene.test[:1])
    changed, other, keywords = changes(model, scene)[name]
    before = {"samples": 2} | ({"perceptual": Brightness(1.0)} if name == "weights" else {})
    evaluate(model, both(scene), partial=tmp_path / "kept.json", **before)
    said.clear()
    evaluate(changed, both(other), partial=tmp_path / "kept.json", **({"samples": 2} | keywords))
    assert "everything is measured anew" in said[0]
    assert sum(text.startswith("[") for text in said) == len(other.train) + 1
