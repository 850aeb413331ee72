"""Every reader of the program with a good file for it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzz import samples
from fuzz.harness import Target

from ca_reg.monitor import read_dynamics
from reference_trainer.evaluation.lpips import load_lpips
from reference_trainer.evaluation.tables import comparison_table, evaluation_table, summary
from reference_trainer.model.ply import load_ply
from reference_trainer.runs.folder import read_results, read_run_settings
from reference_trainer.runs.grid import outcome_line
from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.images import LARGEST_IMAGE, read_image
from reference_trainer.scenes.load import file_split
from reference_trainer.scenes.numpy_formats import read_arrays, read_idr, read_llff
from reference_trainer.scenes.points import ply_points
from reference_trainer.scenes.transforms import read_transforms
from reference_trainer.training.checkpoint import load_checkpoint
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.trainer import Trainer

__all__ = ["TARGETS"]

JSON = 40  # bytes of Python objects for one of text: {"":0}, is 7 and a dict 232
NAMES = [f"r_{i}.png" for i in range(samples.VIEWS)]


def _model_fits(model: Any) -> None:
    points = model.points
    assert len(points.positions) == len(points.colors) == len(points.tracks)
    assert points.positions.shape[1:] == points.colors.shape[1:] == (3,)
    assert all(np.allclose(i.world_to_camera[:3, :3] @ i.world_to_camera[:3, :3].T, np.eye(3)) for i in model.images)


def _frames_fit(frames: Any) -> None:
    assert len(frames) == samples.VIEWS or len({frame.name for frame in frames}) == len(frames)
    for camera in (frame.camera for frame in frames):
        assert camera.fx > 0
        assert camera.fy > 0
        assert camera.width > 0
        assert camera.height > 0


def _points_fit(cloud: Any) -> None:
    assert cloud.positions.shape == cloud.colors.shape
    assert cloud.positions.shape[1:] == (3,)
    assert bool(((cloud.colors >= 0) & (cloud.colors <= 1)).all())


def _gaussians_fit(model: Any) -> None:
    assert model.gaussians.means.dtype == torch.float32
    assert 0 < model.opacity_scale <= 1


def _picture_fits(picture: Any) -> None:
    image, alpha = picture
    assert image.shape[0] == 3
    assert alpha is None or alpha.shape == image.shape[1:]
    assert bool(((image >= 0) & (image <= 1)).all())


def _split_fits(split: Any) -> None:
    train, test = split
    assert train
    assert not set(train) & set(test)


def _lpips_weights(folder: Path) -> Any:
    metric = load_lpips(folder / "lpips.pth")
    assert metric is not None
    metric(torch.zeros(3, 32, 32), torch.ones(3, 32, 32))
    return [parameter for stage in metric._stages for parameter in stage.parameters()] + metric._heads


def _two_steps(folder: Path) -> Any:
    """Continue a training, up to its densification: a state that is half wrong shows in what the steps make of it."""
    trainer = Trainer.load(folder / "checkpoint.pt", samples.small_scene())
    try:
        for _ in range(min(2, trainer.config.iterations - trainer.step)):
            trainer.train_step()
    except TrainingStoppedError:  # finite, but nothing to draw: told in the words of the training
        return None
    return trainer


def _trainer_fits(trainer: Any) -> None:
    if trainer is None:
        return
    count = len(trainer.gaussians)
    assert count > 0
    for x in (*(x for _, x in trainer.gaussians.named()), *trainer.density.state_dict().values()):
        assert x.dtype == torch.float32
        assert len(x) == count
        assert bool(x.isfinite().all()), "values that are not finite"
    for moments in trainer.optimizer.state_dict()["moments"].values():
        assert all(bool(x.isfinite().all()) for x in moments.values()), "moments that are not finite"


def _results_fit(results: Any) -> None:
    """Whatever shows results must take them; an error of any kind ends the test."""
    assert comparison_table({"a": [results]})
    assert evaluation_table(results)
    assert summary(results)
    assert outcome_line(results, "now")


TARGETS = (
    *(
        Target(f"COLMAP {name}.bin", f"{name}.bin", samples.write_colmap_binary, read_colmap, "binary",
               expansion=15,
               check=_model_fits)
        for name in ("cameras", "images", "points3D")
    ),
    *(
        Target(f"COLMAP {name}.txt", f"{name}.txt", samples.write_colmap_text, read_colmap, "text",
               expansion=40, check=_model_fits)
        for name in ("cameras", "images", "points3D")
    ),
    Target(
        "LLFF poses_bounds.npy",
        "poses_bounds.npy",
        samples.write_llff,
        lambda folder: read_llff(folder / "poses_bounds.npy", folder / "images"),
        "binary",
        check=_frames_fit,
    ),
    Target(
        "IDR cameras_sphere.npz",
        "cameras_sphere.npz",
        samples.write_idr,
        lambda folder: read_idr(folder / "cameras_sphere.npz", folder / "image"),
        "binary",
        checksummed=True,
        check=_frames_fit,
    ),
    Target(
        "poses and points .npz",
        "predictions.npz",
        samples.write_arrays,
        lambda folder: read_arrays(folder / "predictions.npz", folder / "images"),
        "binary",  # the names of the arrays are outside the checksums, and those that nobody knows are passed over
        check=lambda found: (_frames_fit(found[0]), found[1] is None or _points_fit(found[1])),
    ),
    Target(
        "Blender transforms.json",
        "transforms.json",
        samples.write_blender,
        lambda folder: read_transforms(folder / "transforms.json"),
        "json",
        expansion=JSON,
        check=_frames_fit,
    ),
    *(
        Target(
            f"split.json, {views or 'its own'} views",
            "split.json",
            samples.write_split,
            lambda folder, views=views: file_split(folder / "split.json", NAMES, views),  # type: ignore[misc]
            "json",
            expansion=JSON,
            check=_split_fits,
        )
        for views in (None, 1, 2)
    ),
    Target("PLY points, binary", "points.ply", samples.write_points, lambda folder: ply_points(folder / "points.ply"),
           "binary", check=_points_fit),
    Target("PLY points, ASCII", "points.ply", partial(samples.write_points, form="ascii"),
           lambda folder: ply_points(folder / "points.ply"), "text", check=_points_fit),
    Target("PLY model, binary", "model.ply", samples.write_model, lambda folder: load_ply(folder / "model.ply"),
           "binary", finite=False, check=_gaussians_fit),
    Target("PLY model, ASCII", "model.ply", samples.write_model_ascii, lambda folder: load_ply(folder / "model.ply"),
           "text", finite=False, check=_gaussians_fit),
    Target("checkpoint", "checkpoint.pt", samples.write_checkpoint,
           lambda folder: load_checkpoint(folder / "checkpoint.pt"), "tensors", checksummed=True,
           memory=50_000_000),
    Target("Trainer.load", "checkpoint.pt", samples.write_trainer, _two_steps, "state", check=_trainer_fits),
    Target("LPIPS weights", "lpips.pth", samples.write_lpips, _lpips_weights, "tensors", checksummed=True,
           memory=50_000_000),
    Target("LPIPS weights, old format", "lpips.pth", partial(samples.write_lpips, archive=False), _lpips_weights,
           "binary"),
    *(
        Target(f"image, {form}", "picture", partial(samples.write_image, form=form),
               lambda folder: read_image(folder / "picture"), "binary", checksummed=form == "PNG",
               memory=25 * LARGEST_IMAGE, check=_picture_fits)
        for form in ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
    ),
    Target("run config.json", "config.json", samples.write_run_settings,
           lambda folder: read_run_settings(folder / "config.json"), "json", expansion=JSON),
    Target("run results.json", "results.json", samples.write_results, read_results, "json", finite=False,
           expansion=JSON, check=_results_fit),
    Target("monitor log", "ca.jsonl", samples.write_log, read_dynamics, "json", finite=False, grows=True,
           expansion=JSON),
)  # fmt: skip
