"""Photographs as people have them, and what of a video is taken."""

import sys

import numpy as np
import pytest
from PIL import Image

from reference_trainer.scenes.photographs import collect_photographs, sharpest_frames, sort_photographs

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


def test_a_photograph_that_is_there_twice_counts_once(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    (tmp_path / "IMG_1.HEIC").write_bytes(b"whatever")
    jpeg = saved(tmp_path / "IMG_1.JPG", picture())
    assert sort_photographs(tmp_path) == ([jpeg], {})


@pytest.mark.parametrize(("name", "module"), [("IMG_1.HEIC", "pi_heif"), ("clip.MOV", "av")])
def test_what_needs_an_extra_says_so(name, module, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"whatever")
    with pytest.raises(ImportError, match=rf"{name}.*ca_reg\[photos\]"):
        sort_photographs(tmp_path)


def test_heic(tmp_path):
    pytest.importorskip("pi_heif", reason="needs ca_reg[photos]")
    pillow_heif = pytest.importorskip("pillow_heif", reason="pi-heif reads HEIC and cannot write it")
    pillow_heif.register_heif_opener()
    saved(tmp_path / "a.HEIC", picture(), quality=95, exif=exif(6))
    (tmp_path / "broken.heic").write_bytes((tmp_path / "a.HEIC").read_bytes()[:60])
    sources, wrong = sort_photographs(tmp_path)
    assert wrong.keys() == {"broken.heic"}
    assert collect_photographs(sources, tmp_path / "out") == ["a.jpg"]
    with Image.open(tmp_path / "out/a.jpg") as made, Image.open(tmp_path / "a.HEIC") as other:
        assert made.getexif().get_ifd(0x8769)[FOCAL_35] == 28
        difference = np.asarray(made).astype(int) - np.asarray(other.convert("RGB")).astype(int)
        assert np.abs(difference).mean() < 3


def test_of_every_part_of_a_video_the_sharpest_frame_is_taken(tmp_path):
    av = pytest.importorskip("av", reason="needs ca_reg[photos]")
    texture = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
    sharp = {2: 0, 13: 1, 18: 2}  # frame of a part that has texture; the others are plain
    with av.open(str(tmp_path / "clip.mp4"), "w") as file:
        stream = file.add_stream("mpeg4", rate=10, options={"qscale": "2"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(24):
            gray = texture if number in sharp else np.full_like(texture, 128)
            level = np.full((48, 64), 40 + 70 * sharp.get(number, 0), np.uint8)
            frame = av.VideoFrame.from_ndarray(np.stack([gray, gray, level], -1), format="rgb24")
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    frames = [np.asarray(frame).astype(float) for frame in sharpest_frames(tmp_path / "clip.mp4", 3)]
    assert [round((frame[..., 2].mean() - 40) / 70) for frame in frames] == [0, 1, 2]
    assert all(frame[..., 0].std() > 40 for frame in frames)
    assert collect_photographs([tmp_path / "clip.mp4"], tmp_path / "out", frames=3) == [
        "clip_0000.jpg", "clip_0001.jpg", "clip_0002.jpg"
    ]  # fmt: skip
    (tmp_path / "no.mp4").write_bytes(b"no video")
    assert sort_photographs(tmp_path)[1].keys() == {"no.mp4"}
