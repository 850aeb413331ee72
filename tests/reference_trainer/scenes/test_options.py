import pytest
import torch

from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions


def test_loading_takes_the_options_by_name():
    assert (
        load_scene("synthetic", downscale=8, views=2)
        .train[0]
        .image.equal(load_scene(SceneOptions("synthetic", downscale=8, views=2)).train[0].image)
    )
    with pytest.raises(TypeError, match="no_such_option"):
        load_scene("synthetic", no_such_option=1)


def test_the_seed_moves_the_points_and_not_the_photographs():
    one, other = (load_scene(SceneOptions("synthetic", downscale=8), seed=seed) for seed in (0, 1))
    assert not torch.equal(one.points.positions, other.points.positions)
    assert torch.equal(one.train[0].image, other.train[0].image)


def test_absolute_options_find_the_scene_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert SceneOptions("my/scene", images="images_8").absolute() == SceneOptions(
        str(tmp_path.resolve() / "my" / "scene"), images="images_8"
    )
    assert SceneOptions("synthetic").absolute() == SceneOptions("synthetic")
