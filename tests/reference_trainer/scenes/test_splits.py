from __future__ import annotations

import json
from fractions import Fraction

import pytest

from reference_trainer.scenes.load import blender_split, evenly_spaced, file_split, llff_split

# Number of images, training views, number of test views of the eight LLFF scenes, as the published code chooses them.
LLFF = {
    "fern": (20, [1, 10, 19], 3),
    "flower": (34, [1, 17, 33], 5),
    "fortress": (42, [1, 21, 41], 6),
    "horns": (62, [1, 30, 61], 8),
    "leaves": (26, [1, 12, 25], 4),
    "orchids": (25, [1, 12, 23], 4),
    "room": (41, [1, 20, 39], 6),
    "trex": (55, [1, 28, 54], 7),
}
BLENDER = [2, 16, 26, 55, 73, 76, 86, 93]


@pytest.mark.parametrize("scene", LLFF)
def test_llff_split_equals_the_published_table(scene):
    count, train, tests = LLFF[scene]
    got_train, got_test = llff_split(count, 3)
    assert got_train == train
    assert len(got_test) == tests
    assert all(i % 8 == 0 for i in got_test)


@pytest.mark.parametrize("count", range(2, 30))
def test_evenly_spaced_is_nearest_to_the_exact_fractions(count):
    for views in range(2, count + 1):
        chosen = evenly_spaced(count, views)
        assert len(set(chosen)) == views
        for i, index in enumerate(chosen):
            # Not "equals round(...)": the published rule rounds floats, which may fall to either side of an exact half.
            assert abs(index - Fraction(i * (count - 1), views - 1)) <= Fraction(1, 2)


def test_halves_go_to_even():
    assert evenly_spaced(6, 3) == [0, 2, 5]
    assert evenly_spaced(8, 3) == [0, 4, 7]


@pytest.mark.parametrize("views", [0, -1, 18])
def test_too_few_or_too_many_views_are_refused(views):
    with pytest.raises(ValueError, match="1 to 17"):
        llff_split(20, views)


def test_more_views_than_are_not_held_out_are_refused_with_the_way_to_all():
    """The owner of three photographs was told to choose from two, although `--test none` trains on all."""
    with pytest.raises(ValueError, match=r"2 of 3 photographs .*1 to 2, .*--test none"):
        llff_split(3, 5)


def test_blender_split():
    assert blender_split(100, 200, 8) == (BLENDER, list(range(0, 200, 8)))
    assert blender_split(8, 25, 8) == (list(range(8)), list(range(25)))
    assert blender_split(5, 3, 8) == ([0, 1, 2, 3, 4], [0, 1, 2])
    assert blender_split(100, 200, 2)[0] == [0, 99]
    with pytest.raises(ValueError, match="training views"):
        blender_split(0, 25, 8)


NAMES = ["000.png", "001.png", "002.png", "003.png", "004.png", "005.png"]


@pytest.mark.parametrize(
    ("content", "views", "train"),
    [
        ({"train": ["003.png", "001.png"], "test": ["000.png"]}, None, [1, 3]),
        ({"train": ["001.jpg", "003"], "test": ["000.png"]}, 2, [1, 3]),
        ({"train_3": ["001.png", "003.png", "005.png"], "test": ["000.png"]}, None, [1, 3, 5]),
        ({"train_2": ["002.png", "003.png"], "train": ["001.png", "004.png"], "test": ["000.png"]}, 2, [2, 3]),
        ({"train_all": NAMES[1:], "train_3": NAMES[1:4], "test": ["000.png"]}, 2, [1, 5]),
        ({"rule": "some words", "train_all": NAMES[1:], "test": ["000.png"]}, 5, [1, 2, 3, 4, 5]),
    ],
)
def test_file_split_picks_the_list(tmp_path, content, views, train):
    path = tmp_path / "split.json"
    path.write_text(json.dumps(content))
    assert file_split(path, NAMES, views) == (train, [0])


@pytest.mark.parametrize(
    ("text", "views", "reason"),
    [
        ("{", None, "not valid JSON"),
        ("[1]", None, "no training set"),
        ('{"train": ["001.png"]}', None, "no list 'test'"),
        ('{"train": ["001.png"], "test": ["000.png"]}', 2, "no training set of 2 views; it has {'train': 1}"),
        ('{"train": ["009.png"], "test": ["000.png"]}', None, "names the image '009.png'"),
        ('{"train": ["001.png", "001"], "test": ["000.png"]}', None, "twice"),
        ('{"train": ["001.png"], "test": ["001.png"]}', None, "both to train"),
    ],
)
def test_file_split_says_what_is_wrong(tmp_path, text, views, reason):
    path = tmp_path / "split.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        file_split(path, NAMES, views)
