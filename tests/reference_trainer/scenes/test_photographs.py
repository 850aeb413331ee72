"""Photographs as people have them, and what of a video is taken."""

import shutil
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from reference_trainer.scenes import photographs
from reference_trainer.scenes.images import image_size, read_image
from reference_trainer.scenes.photographs import (
    collect_photographs,
    sharpest_frames,
    sort_photographs,
    unread_folders,
)

ORIENTATION, FOCAL_35 = 0x0112, 0xA405  # EXIF


def picture(seed: int = 0, height: int = 64, width: int = 96) -> np.ndarray:
    """Plain quarters of whole blocks of JPEG, each of another color, which it keeps."""
    colors = np.random.default_rng(seed).integers(30, 220, (2, 2, 3), dtype=np.uint8)
    return colors.repeat(height // 2, 0).repeat(width // 2, 1)


def saved(path, pixels, **rest):
    Image.fromarray(pixels).save(path, **rest)
    return path


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[ORIENTATION] = orientation
    tags.get_ifd(0x8769)[FOCAL_35] = 28
    return tags


def test_what_colmap_reads_is_copied_and_the_rest_is_made_so(tmp_path):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    upright = saved(photos / "a.JPG", picture(0), quality=95, exif=exif(1))
    plain = saved(photos / "b.png", picture(1))
    saved(photos / "c.webp", picture(2), quality=95)
    turns = {1: 0, 3: 2, 6: 3, 8: 1}  # quarter turns, counter-clockwise, that set a picture upright
    for tag in (3, 6, 8):
        saved(photos / f"turned_{tag}.jpg", picture(tag), quality=95, exif=exif(tag))
    sources, wrong = sort_photographs(photos)
    assert not wrong
    names = collect_photographs(sources, out)
    assert sorted(names) == sorted(path.name for path in out.iterdir())
    assert names == ["a.JPG", "b.png", "c.jpg", "turned_3.jpg", "turned_6.jpg", "turned_8.jpg"]
    for file in (upright, plain):
        assert (out / file.name).read_bytes() == file.read_bytes()
    for name, tag in (("c.jpg", 2), *((f"turned_{tag}.jpg", tag) for tag in (3, 6, 8))):
        with Image.open(out / name) as made:
            assert made.format == "JPEG"
            expected = np.rot90(picture(tag), turns.get(tag, 0)).astype(int)
            assert made.size[::-1] == expected.shape[:2]
            assert np.abs(np.asarray(made).astype(int) - expected).mean() < 5  # JPEG; a wrong turn is 50 off
            if tag != 2:
                assert made.getexif().get(ORIENTATION, 1) == 1
                assert made.getexif().get_ifd(0x8769)[FOCAL_35] == 28


@pytest.mark.parametrize("tag", [1, 3, 6])
def test_a_tiff_keeps_its_orientation_and_focal_length(tag, tmp_path):
    """Of other programs it is turned by its tag, and its EXIF data are tags of the file among others."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[ORIENTATION], tags[0x8769], tags[0x010F], tags[700] = tag, {FOCAL_35: 28}, "maker", bytes(100_000)
    path = saved(tmp_path / "a.tif", picture(), tiffinfo=tags)
    assert np.array_equal(read_image(path)[0].permute(1, 2, 0).numpy(), picture() / np.float32(255))
    assert image_size(path) == (96, 64)
    assert collect_photographs([path], tmp_path / "out") == ["a.jpg"]
    with Image.open(tmp_path / "out/a.jpg") as made:
        expected = np.rot90(picture(), {1: 0, 3: 2, 6: 3}[tag]).astype(int)
        assert made.size[::-1] == expected.shape[:2]
        assert np.abs(np.asarray(made).astype(int) - expected).mean() < 5
        assert made.getexif()[0x010F] == "maker"
        assert made.getexif().get_ifd(0x8769)[FOCAL_35] == 28


def test_what_cannot_be_read_is_named(tmp_path):
    whole = saved(tmp_path / "whole.jpg", picture())
    (tmp_path / "half.jpg").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    (tmp_path / "raw.CR2").write_bytes(b"II*\0")
    (tmp_path / "notes.txt").write_text("no photograph")
    (tmp_path / "._whole.jpg").write_bytes(b"of macOS")
    usable, wrong = sort_photographs(tmp_path)
    assert usable == [whole]
    assert wrong.keys() == {"half.jpg", "raw.CR2"}
    assert "JPEG or PNG" in wrong["raw.CR2"]


def test_what_a_phone_writes_of_one_photograph_counts_once(tmp_path, monkeypatch):
    for module in ("pi_heif", "av"):
        monkeypatch.setitem(sys.modules, module, None)
    for name in ("IMG_1.HEIC", "IMG_1.MOV", "IMG_1.DNG"):
        (tmp_path / name).write_bytes(b"whatever")
    jpeg = saved(tmp_path / "IMG_1.JPG", picture())
    assert sort_photographs(tmp_path) == ([jpeg], {})


def test_equal_files_are_taken_once_and_named(tmp_path):
    first = saved(tmp_path / "a.jpg", picture())
    for name in ("a (1).jpg", "b.JPG"):
        (tmp_path / name).write_bytes(first.read_bytes())
    other = saved(tmp_path / "c.jpg", picture(1))
    assert sort_photographs(tmp_path) == (
        [first, other],
        {name: f"{name} is the same file as a.jpg" for name in ("a (1).jpg", "b.JPG")},
    )


def test_different_photographs_of_one_name_are_all_kept(tmp_path, monkeypatch):
    files = [saved(tmp_path / name, picture(i)) for i, name in enumerate(("A.jpeg", "a.jpg", "a.png", "a.webp"))]
    (clip := tmp_path / "clip.mp4").write_bytes(b"fake")
    files += [clip, saved(tmp_path / "clip_0000.jpg", picture(9))]
    frames = [Image.fromarray(picture(i)) for i in (6, 7)]
    monkeypatch.setattr(photographs, "sharpest_frames", lambda path, count: iter(frames))
    monkeypatch.setattr(photographs, "_check_video", lambda path: None)
    sources, wrong = sort_photographs(tmp_path)
    assert (sources, wrong) == (files, {})
    names = collect_photographs(sources, tmp_path / "out")
    assert names == [
        "A.jpeg", "a_2.jpg", "a_3.png", "a_4.jpg", "clip_0000.jpg", "clip_0001.jpg", "clip_0000_2.jpg"
    ]  # fmt: skip
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
    for name, seed in zip(names, (0, 1, 2, 3, 6, 7, 9), strict=True):
        with Image.open(tmp_path / "out" / name) as made:
            assert np.abs(np.asarray(made).astype(int) - picture(seed)).mean() < 5


def test_rare_endings_are_read_and_what_is_no_photograph_is_named(tmp_path):
    for i, name in enumerate(("a.jfif", "b.JPE")):
        saved(tmp_path / name, picture(i), format="JPEG")
    for name in ("sheet.pdf", "README", "scan.cr9"):
        (tmp_path / name).write_bytes(name.encode())
    for name in ("IMG_1.AAE", "a.xmp", "notes.txt", "Thumbs.db", "desktop.ini", ".DS_Store", "._a.jpg", "poses.npy"):
        (tmp_path / name).write_bytes(name.encode())
    sources, wrong = sort_photographs(tmp_path)
    assert collect_photographs(sources, tmp_path / "out") == ["a.jfif", "b.JPE"]
    assert wrong.keys() == {"sheet.pdf", "README", "scan.cr9"}
    assert wrong["sheet.pdf"] == "PDF is not read: save it as JPEG or PNG, if it is a photograph"


def test_photographs_in_other_folders_are_named(tmp_path):
    for folder in ("DCIM/100", "DCIM/101", ".trash", "notes", "masks", "out/render_flight"):
        (tmp_path / folder).mkdir(parents=True)
    hidden = (".trash/d.jpg", "masks/a.jpg", "out/render_flight/0000.png")
    for name in ("DCIM/100/a.jpg", "DCIM/100/b.jpg", "DCIM/101/c.jpg", *hidden):
        saved(tmp_path / name, picture())
    (tmp_path / "notes" / "e.txt").touch()
    found = unread_folders(tmp_path, tmp_path / "out")
    assert found.keys() == {str(tmp_path / "DCIM/100"), str(tmp_path / "DCIM/101")}
    said = found[str(tmp_path / "DCIM/100")]
    assert said.startswith(
        f"photographs or videos in {tmp_path / 'DCIM/100'} are not read (2): move them to {tmp_path}, or"
    )


def test_a_folder_images_counts_only_if_pictures_are_there(tmp_path):
    outside = saved(tmp_path / "a.jpg", picture())
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "notes.txt").touch()
    assert sort_photographs(tmp_path)[0] == [outside]
    assert not unread_folders(tmp_path, tmp_path / "out")
    inside = saved(tmp_path / "images" / "b.jpg", picture())
    assert sort_photographs(tmp_path)[0] == [inside]
    (tmp_path / "images_2").mkdir()
    saved(tmp_path / "images_2" / "b.jpg", picture())
    (said,) = unread_folders(tmp_path, tmp_path / "out").values()
    assert "(1)" in said
    assert f"in {tmp_path} are not read" in said


def test_transparency_stays(tmp_path):
    pixels = np.dstack([picture(), picture(1)[..., 0]])
    saved(tmp_path / "turned.png", pixels, exif=exif(6))
    saved(tmp_path / "web.webp", pixels, lossless=True)
    names = collect_photographs(sort_photographs(tmp_path)[0], tmp_path / "out")
    assert names == ["turned.png", "web.png"]
    for name, turns in zip(names, (3, 0), strict=True):
        with Image.open(tmp_path / "out" / name) as made:
            assert np.array_equal(np.asarray(made), np.rot90(pixels, turns))
            assert made.getexif().get(ORIENTATION, 1) == 1


@pytest.mark.parametrize(("name", "module"), [("IMG_1.HEIC", "pi_heif"), ("clip.MOV", "av"), ("clip.3gp", "av")])
def test_what_needs_an_extra_says_so(name, module, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"whatever")
    with pytest.raises(ImportError, match=rf"{name}.*ca_reg\[photos\]"):
        sort_photographs(tmp_path)


def test_heic(tmp_path):
    """``turned.heic`` holds `picture` as a phone held upright writes it: turned, which its header and EXIF data say."""
    pytest.importorskip("pi_heif", reason="needs ca_reg[photos]")
    shutil.copy(Path(__file__).with_name("turned.heic"), tmp_path / "a.HEIC")
    (tmp_path / "a.mov").write_bytes(b"of a live photo")
    (tmp_path / "broken.heic").write_bytes((tmp_path / "a.HEIC").read_bytes()[:60])
    sources, wrong = sort_photographs(tmp_path)
    assert wrong.keys() == {"broken.heic"}
    assert collect_photographs(sources, tmp_path / "out") == ["a.jpg"]
    with Image.open(tmp_path / "out/a.jpg") as made:
        assert made.getexif().get_ifd(0x8769)[FOCAL_35] == 28
        assert made.getexif().get(ORIENTATION, 1) == 1
        expected = np.rot90(picture(), 3).astype(int)
        assert made.size[::-1] == expected.shape[:2]
        assert np.abs(np.asarray(made).astype(int) - expected).mean() < 5


@pytest.mark.parametrize(("degrees", "turns"), [(0, 0), (90, 1), (-90, 3), (180, 2)])
def test_the_frames_of_a_video_are_turned_as_it_says(degrees, turns):
    frame = SimpleNamespace(to_image=lambda: Image.fromarray(picture()), rotation=degrees)  # counter-clockwise
    assert np.array_equal(np.asarray(photographs._of_video(frame)), np.rot90(picture(), turns))


def test_a_video_without_a_frame_is_named(tmp_path, monkeypatch):
    class Video:
        __enter__ = __exit__ = lambda self, *_: self

        def decode(self, video):
            return iter(())

    monkeypatch.setattr(photographs, "_opened_video", lambda path: Video())
    (tmp_path / "clip.mp4").write_bytes(b"fake")
    assert sort_photographs(tmp_path) == ([], {"clip.mp4": "it holds no pictures"})


def film(path, start=0, **options):
    """Write 24 frames of which three, in different thirds, have texture and levels of blue 40, 110 and 180."""
    av = pytest.importorskip("av", reason="needs ca_reg[photos]")
    texture = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
    sharp = {2: 0, 13: 1, 18: 2}  # frame of a part that has texture; the others are plain
    with av.open(str(path), "w", options=options) as file:
        stream = file.add_stream("mpeg4", rate=10, options={"qscale": "2"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(24):
            gray = texture if number in sharp else np.full_like(texture, 128)
            level = np.full((48, 64), 40 + 70 * sharp.get(number, 0), np.uint8)
            frame = av.VideoFrame.from_ndarray(np.stack([gray, gray, level], -1), format="rgb24")
            frame.pts, frame.time_base = start + number, Fraction(1, 10)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    ("name", "start", "options"), [("a.mp4", 0, {}), ("late.mp4", 500, {}), ("b.mkv", 0, {"live": "1"})]
)
def test_of_every_part_of_a_video_the_sharpest_frame_is_taken(name, start, options, tmp_path):
    """Also of one that begins late, as clips of camcorders do, and of one whose header does not say how long it is."""
    frames = [np.asarray(frame).astype(float) for frame in sharpest_frames(film(tmp_path / name, start, **options), 3)]
    assert [round((frame[..., 2].mean() - 40) / 70) for frame in frames] == [0, 1, 2]
    assert all(frame[..., 0].std() > 40 for frame in frames)


def test_frames_of_a_video_are_collected_and_what_is_none_is_named(tmp_path, caplog):
    film(tmp_path / "clip.mp4")
    with caplog.at_level("INFO"):
        assert collect_photographs([tmp_path / "clip.mp4"], tmp_path / "out", frames=3) == [
            "clip_0000.jpg", "clip_0001.jpg", "clip_0002.jpg"
        ]  # fmt: skip
    assert "clip.mp4: looking for" in caplog.text
    assert sort_photographs(tmp_path / "clip.mp4") == ([tmp_path / "clip.mp4"], {})
    (tmp_path / "no.mp4").write_bytes(b"no video")
    assert sort_photographs(tmp_path)[1].keys() == {"no.mp4"}
