"""Small good files of every format that the program reads."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import struct
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from reference_trainer.evaluation.evaluate import Evaluation, ViewScores
from reference_trainer.evaluation.results import write_json
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import save_ply
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.checkpoint import save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = [
    "small_scene", "write_arrays", "write_blender", "write_checkpoint", "write_colmap_binary", "write_colmap_text",
    "write_image", "write_llff", "write_log", "write_lpips", "write_model", "write_model_ascii", "write_points",
    "write_results", "write_run_settings", "write_split", "write_trainer",
]  # fmt: skip

VIEWS = 3
POINTS = 20


def _pose(i: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    angle = 0.1 * i
    return (float(np.cos(angle)), 0.0, float(np.sin(angle)), 0.0), (0.25 * i, -0.5, 4.0)


def write_colmap_binary(folder: Path) -> None:
    """Two cameras, three images with two features each, twenty points."""
    cameras = struct.pack("<QiiQQ4d", 2, 1, 1, 64, 48, 50.5, 51.25, 32.0, 24.0)
    cameras += struct.pack("<iiQQ4d", 7, 2, 32, 24, 40.0, 16.0, 12.0, 0.125)
    images, points = struct.pack("<Q", VIEWS), struct.pack("<Q", POINTS)
    for i in range(VIEWS):
        q, t = _pose(i)
        images += struct.pack("<i7di", i + 1, *q, *t, 1 if i else 7) + f"r_{i}.png".encode() + b"\0"
        images += struct.pack("<Qddqddq", 2, 1.5, 2.5, i, 3.25, 4.75, -1)
    for i in range(POINTS):
        points += struct.pack("<Q3d3BdQ4i", i, 0.5 * i, -1.0, 2.0, i, 100, 255, 0.5, 2, 1, 0, 2, 1)
    for name, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(data)


def write_colmap_text(folder: Path) -> None:
    """The same in text, with the comments that COLMAP writes."""
    cameras = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    cameras += "# Number of cameras: 2\n1 PINHOLE 64 48 50.5 51.25 32 24\n7 SIMPLE_RADIAL 32 24 40 16 12 0.125\n"
    images = "# Image list with two lines of data per image:\n"
    images += f"# Number of images: {VIEWS}, mean observations per image: 2\n"
    points = f"# 3D point list with one line of data per point:\n# Number of points: {POINTS}, mean track length: 2\n"
    for i in range(VIEWS):
        q, t = _pose(i)
        images += " ".join(map(str, (i + 1, *q, *t, 1 if i else 7, f"r_{i}.png"))) + f"\n1.5 2.5 {i} 3.25 4.75 -1\n"
    for i in range(POINTS):
        points += f"{i} {0.5 * i} -1.0 2.0 {i} 100 255 0.5 1 0 2 1\n"
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text(text)


def _pictures(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for i in range(VIEWS):
        Image.fromarray(np.full((6, 8, 3), 40 * i, np.uint8)).save(folder / f"r_{i}.png")


def write_llff(folder: Path) -> None:
    """Three poses and pictures."""
    _pictures(folder / "images")
    row = [0, 1, 0, 0, 6, 1, 0, 0, 0.5, 8, 0, 0, -1, 2, 9.5, 1.25, 40]
    np.save(folder / "poses_bounds.npy", np.array([row] * VIEWS, np.float64))


def write_idr(folder: Path) -> None:
    """Three cameras K [R | t], the sphere around the object, and pictures."""
    _pictures(folder / "image")
    world = np.array([[9.0, 0.0, 4.0, 1.0], [0.0, 9.5, 3.0, 2.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    arrays = {f"{kind}_mat_{i}": x for kind, x in (("world", world), ("scale", np.eye(4))) for i in range(VIEWS)}
    np.savez(folder / "cameras_sphere.npz", **arrays)


def write_arrays(folder: Path) -> None:
    """Three cameras, points with colors and confidence, names, and pictures."""
    _pictures(folder / "images")
    points = np.arange(3.0 * POINTS).reshape(POINTS, 3)
    np.savez(
        folder / "predictions.npz", extrinsic=np.stack([np.eye(4)] * VIEWS),
        intrinsic=np.array([[9.0, 0.0, 4.0], [0.0, 9.5, 3.0], [0.0, 0.0, 1.0]]), points=points,
        colors=points.astype(np.uint8), conf=np.arange(1.0 * POINTS),
        names=np.array([f"r_{i}.png" for i in range(VIEWS)]),
    )  # fmt: skip


def write_blender(folder: Path) -> None:
    """A transforms file with every key that is read, and pictures."""
    _pictures(folder / "train")
    frames = [
        {"file_path": f"./train/r_{i}", "transform_matrix": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}
        for i in range(VIEWS)
    ]
    content = {"camera_angle_x": 0.7, "fl_x": 9.0, "fl_y": 9.5, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1))


def write_split(folder: Path) -> None:
    """A split file with all of its lists."""
    content = {"test": ["r_0.png"], "train": ["r_1", "r_2"], "train_all": ["r_1.png", "r_2.png"], "train_1": ["r_2"]}
    (folder / "split.json").write_text(json.dumps(content, indent=1))


def write_points(folder: Path, form: str = "binary_little_endian") -> None:
    """A colored point cloud."""
    names = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    header = ["ply", f"format {form} 1.0", "comment made by hand", f"element vertex {POINTS}", *names, "end_header", ""]
    rows = [(0.5 * i, -1.5, 2.0, i, 100, 255) for i in range(POINTS)]
    binary = b"".join(struct.pack("<3f3B", *row) for row in rows)
    body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode() if form == "ascii" else binary
    (folder / "points.ply").write_bytes("\n".join(header).encode() + body)


def _gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    positions, colors = torch.rand(2, POINTS, 3, generator=generator)
    return Gaussians.from_points(positions, colors, torch.full((POINTS,), 0.1), sh_degree=1)


def write_model(folder: Path) -> None:
    """A model as the trainer writes it, with a comment that readers understand."""
    save_ply(_gaussians(), folder / "model.ply", bake_p=0.2)


def write_model_ascii(folder: Path) -> None:
    """The same model as text."""
    write_model(folder)
    header, _, body = (folder / "model.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(POINTS, -1)
    text = "".join(" ".join(f"{x:.9g}" for x in row) + "\n" for row in rows)
    header = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    (folder / "model.ply").write_bytes(header + text.encode())


def write_checkpoint(folder: Path) -> None:
    """A checkpoint with everything that the trainer puts into one: tensors, numbers, strings, lists, None."""
    tensors = dict(_gaussians().named())
    moments = {name: {"mean": torch.zeros_like(x), "steps": torch.ones(())} for name, x in tensors.items()}
    state = {"step": 3, "seconds": 0.5, "scene": "fern", "train_views": ["a", "b"], "nothing": None}
    save_checkpoint(folder / "checkpoint.pt", {**state, "gaussians": tensors, "moments": moments})


@functools.cache
def small_scene() -> Scene:
    """The scene of the trainer, whose step takes milliseconds."""
    return synthetic_scene(width=32, height=24, points=60)


def write_trainer(folder: Path) -> None:
    """A trainer whose next step counts and whose second one densifies, prunes and resets: all of its state is used."""
    config = TrainConfig(
        iterations=5, dropout=0.2, noise=0.3, sh_degree=1, sh_every=1, densify_from=1, densify_every=3,
        opacity_reset_from=3, opacity_reset_every=1,
    )  # fmt: skip
    trainer = Trainer(small_scene(), config)
    trainer.train(until=2)
    trainer.save(folder / "checkpoint.pt")


def write_lpips(folder: Path, *, archive: bool = True) -> None:
    """Weights of the shape of an AlexNet, two channels wide."""
    state: dict[str, torch.Tensor] = {}
    for index, into, size in ((0, 3, 11), (3, 2, 5), (6, 2, 3), (8, 2, 3), (10, 2, 3)):
        state |= {f"features.{index}.weight": torch.ones(2, into, size, size), f"features.{index}.bias": torch.ones(2)}
    state |= {f"lin{i}.model.1.weight": torch.ones(1, 2, 1, 1) for i in range(5)}
    torch.save(state, folder / "lpips.pth", _use_new_zipfile_serialization=archive)


def write_image(folder: Path, form: str) -> None:
    """A picture with structure, so that its file has more than a header."""
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form)
    (folder / "picture").write_bytes(buffer.getvalue())


def write_log(folder: Path) -> None:
    """The log of a monitor."""
    records = [{"step": 10 * i, "gaussians": 5, "ca/test": 0.01 * i, "method": "sampling"} for i in range(1, 5)]
    (folder / "ca.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))


def write_results(folder: Path) -> None:
    """The results of a run with two views."""
    quantities = [name for name in ViewScores.__dataclass_fields__ if name not in ("name", "split", "ca_reason")]
    scores = {name: 0.25 * number for number, name in enumerate(quantities)}
    views = [ViewScores(name="r", split=split, ca_reason="ok", **scores) for split in ("train", "test")]
    content = {"scene": "fern", "config": dataclasses.asdict(TrainConfig()), "seconds": 2.5, "processor_seconds": 2.0}
    write_json(folder / "results.json", content | Evaluation(views, 1000).as_dict())


def write_run_settings(folder: Path) -> None:
    """The settings of a run, as the run writes them."""
    parts = {"scene": SceneOptions(path="/scenes/fern", views=3), "config": TrainConfig(dropout=0.2)}
    content = {name: dataclasses.asdict(part) for name, part in parts.items()}
    (folder / "config.json").write_text(json.dumps(content, indent=1))
