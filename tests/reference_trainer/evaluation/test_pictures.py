from __future__ import annotations

import sys

import matplotlib
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from reference_trainer.evaluation.pictures import (
    PANEL,
    color_bar,
    dynamics_figure,
    file_names,
    heat_map,
    save_film,
    save_png,
    side_by_side,
)
from reference_trainer.evaluation.style import STRATEGIES
from reference_trainer.scenes.images import read_image


@pytest.mark.parametrize(
    ("views", "names"),
    [
        (["0001.jpg", "sub/0002.png", "12.30.01.jpg", "train/r_3"], ["0001", "0002", "12.30.01", "r_3"]),
        (["a/r_0.png", "b/r_0.png"], ["a_r_0", "b_r_0"]),
        (["a.jpg", "a.png"], ["a", "a.png"]),
        (["A/x.png", "b/X.png"], ["A_x", "b_X"]),  # one file, to some file systems
        (["r.png", "r_panel.png"], ["r", "r_panel.png"]),
        (["a/r.png", "b/r.png", "a_r.png"], ["a_r", "b_r", "a_r.png"]),
        ([f"{x}/r.png" for x in ("a/b", "a_b", "a/b/r.png/..")], None),
    ],
)
def test_no_two_views_share_a_file(views, names):
    found = file_names(views)
    assert names is None or found == names
    files = [f"{name}{end}.png".casefold() for name in found for end in ("", PANEL)]
    assert len(set(files)) == 2 * len(views)
    assert not any("/" in name for name in found)


@pytest.mark.parametrize("x", [torch.arange(256) / 255, torch.rand(1000, generator=torch.Generator().manual_seed(0))])
def test_bytes_are_the_nearest(tmp_path, x):
    save_png(tmp_path / "a.png", x.expand(3, 1, -1))
    assert (read_image(tmp_path / "a.png")[0][0, 0] - x).abs().max() <= 0.5 / 255 + 1e-7


def test_png_holds_the_image(tmp_path):
    image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
    save_png(tmp_path / "new" / "a.png", image)
    with Image.open(tmp_path / "new" / "a.png") as picture:
        assert picture.size == (7, 5)
        assert picture.mode == "RGB"
        pixels = np.array(picture)
    assert np.array_equal(pixels, np.round(image.numpy().transpose(1, 2, 0) * 255).astype(np.uint8))
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["a.png"]


def test_png_takes_gradients_and_clamps(tmp_path):
    save_png(tmp_path / "a.png", torch.full((3, 2, 2), 1.5, requires_grad=True))
    with Image.open(tmp_path / "a.png") as picture:
        assert np.array(picture).min() == 255


def test_heat_map_has_the_colors_of_inferno():
    colors = heat_map(torch.tensor([[0.0, 1.0, 2.0], [-1.0, 5.0, 0.5]]), vmax=2.0)
    expected = [matplotlib.colormaps["inferno"](x)[:3] for x in (0.0, 128, 1.0, 0.0, 1.0, 64)]
    torch.testing.assert_close(colors.reshape(3, 6).T, torch.tensor(expected, dtype=torch.float32), atol=1e-6, rtol=0)


def test_heat_map_is_monotone_in_brightness_and_leaves_gray_for_the_undefined():
    colors = heat_map(torch.linspace(0, 1, 100)[None], vmax=1.0)
    brightness = (torch.tensor([0.2126, 0.7152, 0.0722])[:, None, None] * colors).sum(0)[0]
    assert (brightness.diff() >= 0).all()
    undefined = heat_map(torch.tensor([[float("nan"), float("inf")]]), vmax=1.0)
    assert torch.equal(undefined, torch.full((3, 1, 2), 0.5))


def test_side_by_side_places_every_picture():
    pictures = [torch.full((3, 20, 60), level) for level in (0.1, 0.4, 0.7)]
    grid = side_by_side(pictures, ["one", "two", "three"], columns=2)
    assert grid.shape == (3, 2 * 40 + 4, 2 * 60 + 4)
    for k, (top, left) in enumerate([(20, 0), (20, 64), (64, 0)]):
        assert torch.allclose(grid[:, top : top + 20, left : left + 60], pictures[k], rtol=0, atol=0.5 / 255 + 1e-7)
    assert (grid[:, :, 60:64] == 1).all()
    assert (grid[:, 40:44] == 1).all()
    assert (grid[:, 44:, 64:] == 1).all()
    for top, left in [(0, 0), (0, 64), (44, 0)]:
        assert grid[:, top : top + 20, left : left + 60].min() < 0.5, "the label has ink"
    assert not torch.equal(grid[:, :20, :60], grid[:, :20, 64:124])


def test_one_row_by_default_and_no_room_for_absent_columns():
    pictures = [torch.zeros(3, 8, 19)] * 3
    assert side_by_side(pictures, ["a"] * 3).shape == (3, 28, 3 * 19 + 2 * 4)
    assert side_by_side(pictures[:1], ["a"], columns=5).shape == (3, 28, 19)


def test_a_map_has_its_colors_below_it_and_what_they_mean_at_the_ends():
    bar = color_bar("0", "0.02", width=200)
    torch.testing.assert_close(bar[:, 3], heat_map(torch.linspace(0, 1, 200)[None], 1.0)[:, 0], rtol=0, atol=0.003)
    ink = (bar[:, 8:] < 0.5).any(0).any(0).nonzero()[:, 0]
    assert ink.min() < 15
    assert ink.max() > 185
    assert not ((ink > 20) & (ink < 150)).any()  # the numbers stand at the ends
    sheet = side_by_side([torch.zeros(3, 30, 200)] * 2, ["a", "b"], scales=[None, ("0", "0.02")])
    torch.testing.assert_close(sheet[:, 52:80, 204:], bar)
    assert (sheet[:, 52:, :204] == 1).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: heat_map(torch.zeros(3), 1.0), r"\(H, W\)"),
        (lambda: heat_map(torch.zeros(3, 3), 0.0), "vmax"),
        (lambda: save_png("unused.png", torch.zeros(1, 4, 4)), r"\(3, H, W\)"),
        (lambda: save_png("unused.png", torch.full((3, 1, 1), torch.nan)), "NaN"),
        (lambda: side_by_side([], []), "at least one"),
        (lambda: side_by_side([torch.zeros(3, 4, 4)], []), "one label for each"),
        (lambda: side_by_side([torch.zeros(3, 4, 4), torch.zeros(3, 4, 5)], ["a", "b"]), "one size"),
        (lambda: side_by_side([torch.zeros(3, 4, 4)], ["a"], columns=0), "columns"),
    ],
)
def test_wrong_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("ending", ["mp4", "webp"])
def test_a_film_of_pictures_whose_labels_grow(tmp_path, monkeypatch, ending):
    """A title of a picture that says its score is wider at some than at others."""
    if ending == "mp4":
        av = pytest.importorskip("av")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    gray = torch.full((3, 30, 20), 0.5)
    sheets = [side_by_side([gray], [label]) for label in ("exact CA 9.99e-3", "exact CA 10.01e-3", "n/a")]
    assert len({sheet.shape for sheet in sheets}) == 3
    file = save_film(tmp_path, "flight", sheets)
    assert file.suffix == f".{ending}"
    if ending == "mp4":
        with av.open(str(file)) as film:
            frames = [frame.to_image() for frame in film.decode(video=0)]
    else:
        with Image.open(file) as film:
            frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(film)]
    widest = sheets[1].shape[2]
    assert {frame.size for frame in frames} == {(widest // 2 * 2 if ending == "mp4" else widest, 50)}
    assert len(frames) == 3
    for frame in frames:  # the picture to the left, beside it nothing
        assert abs(np.array(frame)[30:45, 2:16].mean() - 128) < 8
        assert np.array(frame)[30:, 50:].mean() > 245


def test_a_label_wider_than_its_picture_is_not_cut():
    wide, narrow = (side_by_side([torch.zeros(3, 4, w)] * 2, ["render 20.51 dB", "error"]) for w in (150, 20))
    black = [int(picture[0, :20].lt(0.5).sum()) for picture in (wide, narrow)]
    assert black[0] == black[1] > 50
    assert narrow.shape[2] < 200


def test_a_strategy_has_one_color_in_every_figure(tmp_path):
    colors = []
    for order in (["baseline", "dropout"], ["dropout/seed_1", "noise", "my run"]):
        for label in order:
            (tmp_path / label).mkdir(parents=True, exist_ok=True)
            (tmp_path / label / "ca.jsonl").write_text('{"step": 1, "ca/test": 0.002, "psnr/test": 20.0}\n')
        dynamics_figure({label: tmp_path / label for label in order}, tmp_path / "dynamics.png")
        with Image.open(tmp_path / "dynamics.png") as picture:
            colors.append({pixel for _, pixel in picture.convert("RGB").getcolors(picture.width * picture.height)})
    rgb = {name: tuple(bytes.fromhex(code[1:])) for name, code in STRATEGIES.items()}
    assert [{name for name in rgb if rgb[name] in each} for each in colors] == [
        {"baseline", "dropout"},
        {"dropout", "noise"},
    ]
