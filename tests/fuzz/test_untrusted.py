"""Files that want more than to be read: to execute code, to take memory, to reach out of the scene folder."""

import json
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz import samples
from PIL import EpsImagePlugin, Image

from reference_trainer.evaluation.lpips import load_lpips
from reference_trainer.scenes.colmap import colmap_frames, read_colmap
from reference_trainer.scenes.images import image_size, read_image
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.numpy_formats import read_llff
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.transforms import read_transforms
from reference_trainer.tensor_files import load_tensors
from reference_trainer.training.checkpoint import load_checkpoint

ROOT = Path(__file__).parents[2]
ESCAPES = ["../../etc/passwd", "/etc/passwd", "..", "images/../../secret.png", "./../secret.png", "a/../../../b.png"]
READERS = {
    "checkpoint.pt": lambda folder: load_checkpoint(folder / "checkpoint.pt"),
    "lpips.pth": lambda folder: load_lpips(folder / "lpips.pth"),
    "poses_bounds.npy": lambda folder: read_llff(folder / "poses_bounds.npy", folder / "images"),
}


class Call:
    """What a pickle makes of it: the result of calling a function."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def write_pickle(path, content, form):
    """Store a malicious object in one of the ways in which PyTorch and NumPy store objects."""
    if form == "archive":
        torch.save(content, path)
    elif form == "old":
        torch.save(content, path, _use_new_zipfile_serialization=False)
    elif form == "pickle":
        path.write_bytes(pickle.dumps(content, protocol=2))
    elif form == "npy":
        with path.open("wb") as file:  # with a name, numpy would append .npy
            np.save(file, np.array([content], object), allow_pickle=True)
    else:
        with path.open("wb") as file:
            np.savez(file, x=np.array([content], object))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("form", ["archive", "old", "pickle", "npy", "npz"])
@pytest.mark.parametrize("depth", [0, 1])
def test_nothing_is_executed(tmp_path, name, form, depth):
    target = tmp_path / "executed"
    evil = Call(os.mkdir, str(target))
    write_pickle(tmp_path / name, {"format": "ca_reg-checkpoint-1", "step": evil} if depth else evil, form)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        READERS[name](tmp_path)
    assert not target.exists()


def test_the_test_above_would_see_an_execution(tmp_path):
    write_pickle(tmp_path / "evil.pt", Call(os.mkdir, str(tmp_path / "executed")), "archive")
    torch.load(tmp_path / "evil.pt", weights_only=False)
    assert (tmp_path / "executed").is_dir()


@pytest.mark.parametrize("read", [read_image, image_size])
def test_postscript_under_the_name_of_a_picture_reaches_no_interpreter(tmp_path, monkeypatch, read):
    # Pillow finds Ghostscript on the PATH and lets it run the program in the file.
    interpreter = tmp_path / "gs"
    interpreter.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    interpreter.chmod(0o755)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    Image.new("RGB", (4, 4)).save(tmp_path / "x.png", "EPS")
    with Image.open(tmp_path / "x.png") as file, pytest.raises(OSError, match=r"."):
        file.load()
    assert (tmp_path / "started").exists()  # the test would see it
    (tmp_path / "started").unlink()
    with pytest.raises(ValueError, match=r"x\.png .*readable.*: .*WebP"):
        read(tmp_path / "x.png")
    assert not (tmp_path / "started").exists()


def test_pictures_are_opened_in_one_place():
    packages = ("reference_trainer", "ca_reg", "integrations")
    files = [file for package in packages for file in (ROOT / package).rglob("*.py")]
    opening = {file.name: file.read_text().count("Image.open(") for file in files}
    assert len(files) > 100
    assert {name: count for name, count in opening.items() if count} == {"images.py": 1}


@pytest.mark.parametrize("name", ["checkpoint.pt", "lpips.pth"])
@pytest.mark.parametrize("function", [bytearray, torch.Tensor, torch.UntypedStorage])
def test_a_few_bytes_do_not_take_a_gigabyte(tmp_path, name, function):
    # All three are on the list of what torch.load(weights_only=True) calls.
    samples.write_checkpoint(tmp_path)
    with zipfile.ZipFile(tmp_path / "checkpoint.pt") as good, zipfile.ZipFile(tmp_path / "evil.pt", "w") as evil:
        for item in good.namelist():
            content = pickle.dumps({"x": Call(function, 10**9)}, protocol=2)
            evil.writestr(item, content if item.endswith("data.pkl") else good.read(item))
    (tmp_path / "evil.pt").replace(tmp_path / name)
    tracemalloc.start()
    with pytest.raises(ValueError, match="not only tensors"):
        READERS[name](tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def nested(kind, levels):
    """Return a pickle of a dict in which 2 ** levels empty containers are, made of one of each level."""
    empty, before, after = {
        "list": (b"]", b"](", b"e"),
        "dict": (b"}", b"}(K\x00", b"K\x01%su"),
        "OrderedDict": (b"}", b"ccollections\nOrderedDict\n)R(K\x00", b"K\x01%su"),
        "tuple": (b")", b"", b"\x86"),
        "key": (b")", b"", b"\x86"),
        "key, stored twice": (b")", b"", b"\x86q\xff"),
    }[kind]
    x = empty + b"q\x00"
    for level in range(levels):
        again = b"h" + bytes([level])
        x = before + x + (after % again if b"%" in after else again + after) + b"q" + bytes([level + 1])
    return b"\x80\x02}X\x01\x00\x00\x00x" + (b"}" + x + b"K\x00s" if kind[:3] == "key" else x) + b"s."


@pytest.mark.parametrize("name", ["checkpoint.pt", "lpips.pth"])
@pytest.mark.parametrize("kind", ["list", "dict", "tuple", "OrderedDict", "key", "key, stored twice"])
def test_what_stands_at_two_places_is_not_unfolded(tmp_path, name, kind):
    # With 40 levels any walk over it would last for years.
    samples.write_checkpoint(tmp_path)
    with zipfile.ZipFile(tmp_path / "checkpoint.pt") as good, zipfile.ZipFile(tmp_path / "evil.pt", "w") as evil:
        for item in good.namelist():
            evil.writestr(item, nested(kind, 40) if item.endswith("data.pkl") else good.read(item))
    (tmp_path / "evil.pt").replace(tmp_path / name)
    with pytest.raises(ValueError, match=r"\w+ at two places"):
        READERS[name](tmp_path)


def test_the_nested_pickles_are_what_they_are_said_to_be():
    pair = pickle.loads(nested("list", 2))["x"]
    assert pair == [[[], []], [[], []]]
    assert pair[0] is pair[1]
    assert pickle.loads(nested("OrderedDict", 1))["x"] == {0: {}, 1: {}}
    assert pickle.loads(nested("key", 1))["x"] == {((), ()): 0}


@pytest.mark.parametrize("archive", [True, False])
def test_a_pickle_without_end_is_not_followed(tmp_path, archive):
    torch.save({"x": [[] for _ in range(100_000)]}, tmp_path / "x.pt", _use_new_zipfile_serialization=archive)
    with pytest.raises(ValueError, match="its tensors in more"):
        load_tensors(tmp_path / "x.pt")


@pytest.mark.parametrize("name", ESCAPES)
def test_colmap_names_stay_in_the_image_folder(tmp_path, name):
    samples.write_colmap_text(tmp_path)
    samples.write_llff(tmp_path)  # its pictures
    (tmp_path / "secret.png").write_bytes((tmp_path / "images" / "r_1.png").read_bytes())
    file = tmp_path / "images.txt"
    file.write_text(file.read_text().replace("r_1.png", name))
    with pytest.raises(ValueError, match="leads out"):
        colmap_frames(read_colmap(tmp_path), tmp_path / "images")


@pytest.mark.parametrize("name", [*ESCAPES, ".", "", "train/.."])
def test_transforms_stay_in_the_scene_folder(tmp_path, name):
    folder = tmp_path / "scene"
    folder.mkdir()
    samples.write_blender(folder)
    for outside in ("scene.png", "secret.png"):  # they would be found
        (tmp_path / outside).write_bytes((folder / "train" / "r_1.png").read_bytes())
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"][1]["file_path"] = name
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"transforms\.json.*(leads out|itself)"):
        read_transforms(file)


@pytest.mark.parametrize("points", ["../points.ply", "/etc/points.ply", "sparse/../../0"])
def test_points_stay_in_the_scene_folder(tmp_path, points):
    folder = tmp_path / "scene"
    folder.mkdir()
    samples.write_llff(folder)
    samples.write_points(tmp_path)
    with pytest.raises(ValueError, match="leads out"):
        load_scene(SceneOptions(folder, points=points, views=1))


def test_links_that_the_user_made_are_followed(tmp_path):
    store, scene = tmp_path / "store", tmp_path / "scene"
    store.mkdir()
    scene.mkdir()
    samples.write_blender(store)
    (scene / "train").symlink_to(store / "train", target_is_directory=True)
    (scene / "transforms.json").symlink_to(store / "transforms.json")
    (tmp_path / "linked").symlink_to(scene, target_is_directory=True)
    frames = read_transforms(tmp_path / "linked" / "transforms.json")
    assert [frame.name for frame in frames] == ["train/r_0", "train/r_1", "train/r_2"]
