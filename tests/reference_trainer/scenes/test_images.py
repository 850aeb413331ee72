from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.scenes.images import (
    composite,
    image_folder,
    image_size,
    list_images,
    match_images,
    path_inside,
    read_image,
    resize_image,
)


def test_reads_the_stored_bytes(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels[:, :, :3].copy()).save(tmp_path / "b.png")
    image, alpha = read_image(tmp_path / "a.png")
    assert image.dtype == alpha.dtype == torch.float32
    assert image.shape == (3, 5, 7)
    assert np.array_equal(image.permute(1, 2, 0).numpy(), pixels[:, :, :3] / np.float32(255))
    assert np.array_equal(alpha.numpy(), pixels[:, :, 3] / np.float32(255))
    opaque, none = read_image(tmp_path / "b.png")
    assert torch.equal(opaque, image)
    assert none is None
    assert image_size(tmp_path / "a.png") == (7, 5)


def test_gray_and_palette_files_become_rgb(tmp_path):
    gray = np.array([[0, 128], [200, 255]], dtype=np.uint8)
    Image.fromarray(gray).save(tmp_path / "gray.png")
    Image.fromarray(gray).convert("P").save(tmp_path / "palette.png", transparency=0)
    image, alpha = read_image(tmp_path / "gray.png")
    assert alpha is None
    assert all(np.array_equal(channel.numpy(), gray / np.float32(255)) for channel in image)
    assert read_image(tmp_path / "palette.png")[1].tolist() == [[0, 1], [1, 1]]


def test_bad_files_are_refused_with_their_path(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no image file .*none\.png"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("not an image")
    with pytest.raises(ValueError, match=r"text\.png .*readable"):
        read_image(tmp_path / "text.png")
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "whole.png")
    (tmp_path / "half.png").write_bytes((tmp_path / "whole.png").read_bytes()[:6000])
    with pytest.raises(ValueError, match=r"half\.png .*readable"):
        read_image(tmp_path / "half.png")
    Image.fromarray(np.full((4, 4), 40_000, np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(ValueError, match="8 bits"):
        read_image(tmp_path / "deep.png")


def test_composite_is_straight_alpha():
    image = torch.tensor([0.8, 0.4, 0.0])[:, None, None].expand(3, 1, 3)
    alpha = torch.tensor([[0.0, 0.5, 1.0]])
    result = composite(image, alpha, torch.tensor([1.0, 0.0, 0.5]))
    expected = torch.tensor([[[1.0, 0.9, 0.8]], [[0.0, 0.2, 0.4]], [[0.5, 0.25, 0.0]]])
    torch.testing.assert_close(result, expected)


@pytest.mark.parametrize(("width", "height"), [(20, 15), (13, 9), (40, 30), (80, 45)])
def test_resize_equals_pillows_bicubic_in_float(width, height):
    generator = torch.Generator().manual_seed(0)
    # Kept away from 0 and 1, so that the clamp does not hide a difference.
    image = 0.3 + 0.4 * torch.rand(3, 30, 40, generator=generator)
    pillow = [
        np.asarray(Image.fromarray(channel.numpy()).resize((width, height), Image.Resampling.BICUBIC))
        for channel in image
    ]
    assert np.abs(resize_image(image, width, height).numpy() - np.stack(pillow)).max() < 1e-6


def test_resize_stays_in_range():
    image = torch.zeros(1, 8, 8)
    image[:, :, 4:] = 1
    resized = resize_image(image, 23, 23)
    assert resized.min() == 0
    assert resized.max() == 1


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()


def test_match_images_by_name_stem_and_order(tmp_path):
    touch(tmp_path / "a", "x.png", "y.png", "z.png", "notes.txt")
    assert match_images(tmp_path / "a", ["y.png"]) == {"y.png": tmp_path / "a" / "y.png"}
    assert match_images(tmp_path / "a", ["y.JPG", "x.JPG"])["x.JPG"].name == "x.png"
    by_order = match_images(tmp_path / "a", ["IMG_3.JPG", "IMG_1.JPG", "IMG_2.JPG"])
    assert {name: file.name for name, file in by_order.items()} == {
        "IMG_1.JPG": "x.png",
        "IMG_2.JPG": "y.png",
        "IMG_3.JPG": "z.png",
    }
    with pytest.raises(ValueError, match=r"lacks 2 .*IMG_1\.JPG.*3 files.*x\.png"):
        match_images(tmp_path / "a", ["IMG_1.JPG", "IMG_2.JPG"])


def test_a_name_is_the_same_with_its_accents_apart(tmp_path):
    """As a Mac writes it; the cameras were found elsewhere."""
    touch(tmp_path / "a", "Tu\N{COMBINING DIAERESIS}r.jpg", "z.jpg")
    found = match_images(tmp_path / "a", ["T\N{LATIN SMALL LETTER U WITH DIAERESIS}r.jpg", "z.jpg"])
    assert [path.name[0] for path in found.values()] == ["T", "z"]


def test_a_renamed_photograph_is_not_paired_with_another_camera(tmp_path):
    """By order all three would be."""
    touch(tmp_path / "a", "IMG_4.JPG", "IMG_6.JPG", "portal.JPG")
    with pytest.raises(ValueError, match=r"lacks 1 .*IMG_2\.JPG.*portal\.JPG"):
        match_images(tmp_path / "a", ["IMG_2.JPG", "IMG_4.JPG", "IMG_6.JPG"])


def test_photographs_of_one_name_in_two_folders_are_not_one_file(tmp_path, save_image):
    for number in range(3):
        save_image(tmp_path / "small" / f"{number}.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(ValueError, match=r"lacks 2 .*another image"):
        match_images(tmp_path / "small", ["left/0.jpg", "right/0.jpg"])


def test_list_images_refuses_empty_and_missing_folders(tmp_path):
    touch(tmp_path, "notes.txt")
    with pytest.raises(ValueError, match=r"no images .*HEIC"):
        list_images(tmp_path)
    with pytest.raises(FileNotFoundError, match="no image folder"):
        list_images(tmp_path / "none")


def test_of_the_folders_with_pictures_the_first_of_usable_size_is_taken(tmp_path):
    def save(folder, width, height):
        folder.mkdir()
        Image.new("RGB", (width, height)).save(folder / "a.png")

    (tmp_path / "images_2").mkdir()
    (tmp_path / "images_2" / "notes.txt").touch()
    save(tmp_path / "images", 1000, 501)
    assert image_folder(tmp_path, None) == tmp_path / "images"  # for want of a smaller one
    save(tmp_path / "images_4", 1000, 500)
    touch(tmp_path / "images_8", "damaged.png")  # it is not opened
    assert image_folder(tmp_path, None) == tmp_path / "images_4"
    assert image_folder(tmp_path, "images_2") == tmp_path / "images_2"


def test_pictures_in_subfolders_are_left_to_what_names_them(tmp_path):
    touch(tmp_path / "images" / "left", "a.png")
    assert image_folder(tmp_path, None) == tmp_path / "images"


@pytest.mark.parametrize("path", ["../secret.png", "/etc/passwd", "a/../../b", "..", "./../x"])
def test_paths_out_of_the_scene_are_refused(path):
    with pytest.raises(ValueError, match="leads out"):
        path_inside("scene", path)


def test_paths_within_the_scene_are_kept():
    assert path_inside("scene", "a/../b.png").as_posix() == "scene/b.png"
    assert path_inside("scene", "..b.png").as_posix() == "scene/..b.png"
    assert path_inside("scene", str(Path("scene/a.png").absolute())).as_posix() == "scene/a.png"
