"""What a file announces and does not have: too much must not allocate, too little not pass for a smaller scene."""

import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch
from fuzz import samples

from ca_reg import CAMonitor, CAScore
from reference_trainer.model.ply import load_ply
from reference_trainer.scenes._colmap_model import view_matrix_from_quaternion
from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.images import LARGEST_IMAGE, read_image
from reference_trainer.scenes.load import file_split
from reference_trainer.scenes.numpy_formats import read_llff
from reference_trainer.scenes.points import ply_points
from reference_trainer.scenes.transforms import read_transforms
from reference_trainer.tensor_files import load_tensors


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("change", [-1, 1, 2**40])
def test_colmap_binary(tmp_path, name, change):
    samples.write_colmap_binary(tmp_path)
    path = tmp_path / f"{name}.bin"
    data = path.read_bytes()
    path.write_bytes(struct.pack("<Q", struct.unpack_from("<Q", data)[0] + change) + data[8:])
    with pytest.raises(ValueError, match=rf"{name}\.bin is (damaged|truncated)"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_colmap_text_is_held_against_its_comment(tmp_path, name):
    samples.write_colmap_text(tmp_path)
    path = tmp_path / f"{name}.txt"
    lines = path.read_text().splitlines(keepends=True)
    for damaged in (lines[:-1], lines[:-3], [*lines[:-1], lines[-1].rstrip("\n")], lines[:1]):
        path.write_text("".join(damaged))
        with pytest.raises(ValueError, match=rf"{name}\.txt is truncated"):
            read_colmap(tmp_path)
    path.write_text("".join(line for line in lines if not line.startswith("#")))  # by hand, without comments
    read_colmap(tmp_path)


def test_a_number_given_twice_hides_no_record(tmp_path):
    samples.write_colmap_binary(tmp_path)
    images = (tmp_path / "images.bin").read_bytes()
    (tmp_path / "images.bin").write_bytes(images[:8] + struct.pack("<i", 2) + images[12:])
    with pytest.raises(ValueError, match="same number"):
        read_colmap(tmp_path)
    cameras = (tmp_path / "cameras.bin").read_bytes()
    (tmp_path / "cameras.bin").write_bytes(cameras[:8] + struct.pack("<i", 7) + cameras[12:])
    with pytest.raises(ValueError, match=r"cameras\.bin: .*camera 7 twice"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("count", [0, 19, 21, 10**15, 10**30])
def test_ply_points(tmp_path, ascii, count):
    samples.write_points(tmp_path, "ascii" if ascii else "binary_little_endian")
    path = tmp_path / "points.ply"
    path.write_bytes(path.read_bytes().replace(b"element vertex 20", f"element vertex {count}".encode()))
    with pytest.raises(ValueError, match=r"points\.ply"):
        ply_points(path)


@pytest.mark.parametrize("write", [samples.write_model, samples.write_model_ascii])
@pytest.mark.parametrize("count", [b"0", b"19", b"21", b"9" * 15, b"9" * 5000, b"20\nelement vertex 20"])
def test_ply_models(tmp_path, write, count):
    write(tmp_path)
    path = tmp_path / "model.ply"
    path.write_bytes(path.read_bytes().replace(b"element vertex 20", b"element vertex " + count))
    with pytest.raises(ValueError, match=r"model\.ply"):
        load_ply(path)


@pytest.mark.parametrize("line", [b"property float\n", b"property float x y\n", b"propertu float nx\n", b"element\n"])
def test_a_header_line_that_is_not_understood_does_not_shift_the_columns(tmp_path, line):
    samples.write_model(tmp_path)
    path = tmp_path / "model.ply"
    path.write_bytes(path.read_bytes().replace(b"property float nx\n", line))
    with pytest.raises(ValueError, match=r"model\.ply: the header line"):
        load_ply(path)


@pytest.mark.parametrize("rows", [2, 4, 10**12])
def test_npy(tmp_path, rows):
    samples.write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    data = path.read_bytes()
    new = f"({rows}, 17)".encode()
    path.write_bytes(data.replace(b"(3, 17), }" + b" " * (len(new) - 7), new + b", }"))
    assert len(path.read_bytes()) == len(data)
    with pytest.raises(ValueError, match=rf"poses_bounds\.npy is damaged: shape \({rows}, 17\)"):
        read_llff(path, tmp_path / "images")


def test_the_header_of_an_npy_file_is_not_believed_about_its_length(tmp_path):
    samples.write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**30) + b"{}")
    tracemalloc.start()
    with pytest.raises(ValueError, match="NumPy array"):
        read_llff(path, tmp_path / "images")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("frames", ['{"a": 1}', '"abc"', "{}", '""', "null", "3"])
def test_frames_that_are_no_list(tmp_path, frames):
    (tmp_path / "transforms.json").write_text(f'{{"camera_angle_x": 0.7, "frames": {frames}}}')
    with pytest.raises(ValueError, match=r"frames .*list"):
        read_transforms(tmp_path / "transforms.json")


def test_an_image_of_too_many_pixels_is_not_decoded(tmp_path):
    side = int(LARGEST_IMAGE**0.5) + 1
    header = b"BM" + struct.pack("<IHHI", 54, 0, 0, 54)
    for width in (side, 10 * side, 100 * side):
        header_of_picture = struct.pack("<IiiHHIIiiII", 40, width, side, 1, 24, 0, 0, 0, 0, 0, 0)
        (tmp_path / "a.bmp").write_bytes(header + header_of_picture)
        with pytest.raises(ValueError, match=r"a\.bmp .*(\d+x\d+ pixels|readable)"):
            read_image(tmp_path / "a.bmp")


def test_a_compressed_checkpoint_is_not_unpacked(tmp_path):
    torch.save({"x": torch.zeros(1_000_000)}, tmp_path / "plain.pt")
    with zipfile.ZipFile(tmp_path / "plain.pt") as plain, zipfile.ZipFile(tmp_path / "bomb.pt", "w", 8) as bomb:
        for name in plain.namelist():
            bomb.writestr(name, plain.read(name))
    assert (tmp_path / "bomb.pt").stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"bomb\.pt .*is compressed"):
        load_tensors(tmp_path / "bomb.pt")


def test_a_tensor_that_repeats_one_number_is_not_believed_about_its_size(tmp_path):
    torch.save({"x": [torch.zeros(()).expand(10**6, 10**6)]}, tmp_path / "large.pt")
    with pytest.raises(ValueError, match=r"large\.pt .*\(1000000, 1000000\) has 4 bytes"):
        load_tensors(tmp_path / "large.pt")


def test_sizes_in_an_old_file_are_not_believed(tmp_path):
    path = tmp_path / "old.pt"
    torch.save({"x": torch.zeros(77)}, path, _use_new_zipfile_serialization=False)
    assert torch.equal(load_tensors(path)["x"], torch.zeros(77))
    path.write_bytes(path.read_bytes().replace(b"K\x4d", b"J\xff\xff\xff\x7f"))
    with pytest.raises(ValueError, match=r"old\.pt .*announces 2147483647 numbers"):
        load_tensors(path)


def test_a_flipped_bit_in_the_weights_is_noticed(tmp_path):
    samples.write_checkpoint(tmp_path)
    data = (tmp_path / "checkpoint.pt").read_bytes()
    at = data.index(np.float32(np.log(0.1)).tobytes())  # a logarithm of a scale
    (tmp_path / "checkpoint.pt").write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(ValueError, match=r"checkpoint\.pt .*(checksum|CRC)"):
        load_tensors(tmp_path / "checkpoint.pt")


def test_a_record_that_calls_itself_a_folder_is_read_all_the_same(tmp_path):
    # torch.load returns memory that nobody wrote for it.
    samples.write_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.pt"
    expected = load_tensors(path)["gaussians"]["means"]
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        at = archive.start_dir
    while (at := data.find(b"PK\x01\x02", at)) >= 0:  # the external attributes of each record in the directory
        data = data[: at + 38] + b"\xff\xff\xff\x7f" + data[at + 42 :]
        at += 42
    path.write_bytes(data)
    assert torch.equal(load_tensors(path)["gaussians"]["means"], expected)


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_text_that_ends_within_a_number(tmp_path, cut):
    for write, name, read in (
        (samples.write_model_ascii, "model.ply", load_ply),
        (lambda folder: samples.write_points(folder, "ascii"), "points.ply", ply_points),
    ):
        write(tmp_path)
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:-cut])
        with pytest.raises(ValueError, match=f"{name}.*(no end|numbers each)"):
            read(path)


def test_a_line_of_one_number_does_not_stand_for_a_line_of_equal_ones(tmp_path):
    samples.write_model_ascii(tmp_path)
    path = tmp_path / "model.ply"
    lines = path.read_bytes().split(b"\n")
    at = lines.index(b"end_header") + 5
    path.write_bytes(b"\n".join([*lines[:at], b"0.5", *lines[at + 1 :]]))
    with pytest.raises(ValueError, match=r"model\.ply: .*26 numbers each: got 1"):
        load_ply(path)


def test_the_checksums_of_a_png_are_compared(tmp_path):
    samples.write_image(tmp_path, "PNG")
    path = tmp_path / "picture"
    data = path.read_bytes()
    at = data.index(b"IEND") - 12  # the last bytes of the compressed pixels stand before their checksum and a length
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(ValueError, match=r"picture .*readable"):
        read_image(path)


def test_a_damaged_log_is_not_shortened_by_a_resumed_run(tmp_path):
    samples.write_log(tmp_path)
    path = tmp_path / "ca.jsonl"
    damaged = path.read_bytes().replace(b'"step": 20', b'"st\xffp": 20')
    path.write_bytes(damaged)
    score = CAScore(lambda opacity, view: (torch.zeros(3, 1, 1), torch.ones(1, 1)))
    with pytest.raises(ValueError, match=r"ca\.jsonl, line 2"):
        CAMonitor(score, tmp_path, views={"test": [0]}, resume_step=40)
    assert path.read_bytes() == damaged


def test_a_tiff_with_lost_strips_is_refused(tmp_path):
    samples.write_image(tmp_path, "TIFF")
    path = tmp_path / "picture"
    height = struct.pack("<HHII", 257, 4, 1, 24)  # ImageLength, a long or short, one value
    data = path.read_bytes()
    assert height in data or struct.pack("<HHI", 257, 3, 1) in data
    at = data.index(struct.pack("<H", 257)) + 8
    path.write_bytes(data[:at] + struct.pack("<H", 2400) + data[at + 2 :])
    with pytest.raises(ValueError, match=r"picture .*768 of its 32x2400 pixels"):
        read_image(path)


def test_a_quaternion_whose_length_overflows_is_no_identity():
    with pytest.raises(ValueError, match="finite non-zero quaternion"):
        view_matrix_from_quaternion((1e200, 1e200, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("bad", ["[1, 2]", '["r_1.png", null]', '[["r_1.png"]]', '["r_1.png", {"a": 1}]'])
@pytest.mark.parametrize("name", ["train_all", "train", "train_1", "test"])
def test_lists_of_other_things_than_names(tmp_path, bad, name):
    samples.write_split(tmp_path)
    path = tmp_path / "split.json"
    content = json.loads(path.read_text()) | {name: json.loads(bad)}
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"split\.json: .*'{name}' must hold names"):
        file_split(path, ["r_0.png", "r_1.png", "r_2.png"], 1)


def test_a_name_that_no_file_system_takes(tmp_path):
    samples.write_blender(tmp_path)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace("r_1", "r" * 5000).replace('"w": 8,', '"width": 8,'))
    with pytest.raises(ValueError, match=r"transforms\.json .*too long"):
        read_transforms(path)


def test_a_header_line_that_is_not_understood_does_not_shift_the_coordinates(tmp_path):
    samples.write_points(tmp_path)
    path = tmp_path / "points.ply"
    path.write_bytes(path.read_bytes().replace(b"property float y\n", b"property float y\npropertu float quality\n"))
    with pytest.raises(ValueError, match=r"points\.ply: the header line"):
        ply_points(path)


def test_a_file_of_lines_is_not_taken_for_a_header(tmp_path):
    path = tmp_path / "points.ply"
    path.write_bytes(b"ply\n" + b"a\n" * 1_000_000)
    tracemalloc.start()
    with pytest.raises(ValueError, match="not a PLY"):
        ply_points(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * path.stat().st_size
