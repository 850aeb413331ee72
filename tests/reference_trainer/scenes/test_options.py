import dataclasses
import inspect

import torch

from reference_trainer.scenes import load as load_module
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions


def test_every_option_of_loading_is_there_with_the_same_default():
    expected = {name: p.default for name, p in inspect.signature(load_scene).parameters.items()}
    expected.pop("seed")
    expected["path"] = "synthetic"
    assert {field.name: field.default for field in dataclasses.fields(SceneOptions)} == expected


def test_every_option_arrives(monkeypatch):
    given = {
        "path": "a", "format": "llff", "images": "images_8", "views": 5, "split": "near", "points": "random:7",
        "downscale": 2.0, "background": "white", "allow_test_points": True,
    }  # fmt: skip
    received: dict = {}
    monkeypatch.setattr(load_module, "load_scene", lambda path, **rest: received.update(path=path, **rest))
    SceneOptions(**given).load(seed=11)
    assert received == given | {"seed": 11}


def test_the_seed_moves_the_points_and_not_the_photographs():
    one, other = (SceneOptions("synthetic", downscale=8).load(seed=seed) for seed in (0, 1))
    assert not torch.equal(one.points.positions, other.points.positions)
    assert torch.equal(one.train[0].image, other.train[0].image)


def test_absolute_options_find_the_scene_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert SceneOptions("my/scene", images="images_8").absolute() == SceneOptions(
        str(tmp_path.resolve() / "my" / "scene"), images="images_8"
    )
    assert SceneOptions("synthetic").absolute() == SceneOptions("synthetic")
