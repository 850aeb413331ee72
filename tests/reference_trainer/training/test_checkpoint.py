"""Checkpoints: written and read, and refused if they are damaged."""

import gc
import json
import math
import os
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from reference_trainer.training.checkpoint import load_checkpoint, save_checkpoint
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.trainer import Trainer

STATE = {"step": 3, "name": "fern", "nothing": None, "deep": {"x": torch.arange(6.0).view(2, 3)}, "views": ["a", "b"]}


def test_round_trip(tmp_path):
    path = tmp_path / "new" / "checkpoint.pt"
    save_checkpoint(path, STATE)
    found = load_checkpoint(path)
    assert torch.equal(found["deep"].pop("x"), STATE["deep"]["x"])
    assert {key: found[key] for key in ("step", "name", "nothing", "views")} == {
        key: STATE[key] for key in ("step", "name", "nothing", "views")
    }


def test_a_disk_that_is_full_half_way_keeps_the_old_file(tmp_path, full_disk):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, STATE)
    old = path.read_bytes()
    with (
        full_disk(100_000),
        pytest.raises(OSError, match=r"before is kept.*checkpoint\.pt"),
    ):
        save_checkpoint(path, {"x": torch.zeros(100_000)})
    gc.collect()  # Python 3.12.1 crashed here
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*nowhere\.pt"):
        load_checkpoint(tmp_path / "nowhere.pt")


@pytest.mark.parametrize("content", [b"", b"garbage", bytes(range(256)) * 4, b"PK\x03\x04" + bytes(99)])
def test_garbage_is_refused_by_name(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.pt .*readable checkpoint"):
        load_checkpoint(path)


def test_a_cut_file_is_refused_by_name(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, STATE)
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"checkpoint\.pt .*readable checkpoint"):
            load_checkpoint(path)


@pytest.mark.parametrize("content", [{"step": 3}, torch.zeros(3), {"format": "another program"}])
def test_files_of_other_programs(tmp_path, content):
    path = tmp_path / "other.pt"
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"other\.pt .*this program"):
        load_checkpoint(path)


class Evil:
    def __init__(self, target: str) -> None:
        self.target = target

    def __reduce__(self):
        return (os.mkdir, (self.target,))


@pytest.mark.parametrize("writer", ["torch", "pickle"])
def test_nothing_in_a_file_is_executed(tmp_path, writer):
    path, target = tmp_path / "evil.pt", tmp_path / "executed"
    content = {"format": "ca_reg-checkpoint-1", "step": Evil(str(target))}
    if writer == "torch":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=r"evil\.pt .*readable checkpoint"):
        load_checkpoint(path)
    assert not target.exists()


KEYS = [
    "config",
    "scene",
    "train_views",
    "step",
    "seconds",
    "processor_seconds",
    "statistics",
    "regularizer",
    "gaussians",
    "moments",
]
Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def saved(tiny_scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("state") / "checkpoint.pt"
    trainer = Trainer(tiny_scene, TrainConfig(iterations=5))
    trainer.train(until=2)
    trainer.save(path)
    return path


def refused(saved: Path, scene: Any, tmp_path: Path, change: Change, said: str) -> None:
    state = load_checkpoint(saved)
    change(state)
    save_checkpoint(tmp_path / "checkpoint.pt", state)
    with pytest.raises(ValueError, match=rf"checkpoint\.pt.*{said}"):
        Trainer.load(tmp_path / "checkpoint.pt", scene)


@pytest.mark.parametrize("key", KEYS)
def test_a_missing_entry(saved, tiny_scene, tmp_path, key):
    refused(saved, tiny_scene, tmp_path, lambda state: state.pop(key), f"it lacks '{key}'; the checkpoint is damaged")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s["gaussians"].pop("sh_dc"), "gaussians: it lacks 'sh_dc'"),
        (lambda s: s["moments"].pop("means"), "it lacks 'means'"),
        (lambda s: s["moments"]["means"].pop("exp_avg"), "it lacks 'exp_avg'"),
        (lambda s: s["statistics"].pop("steps"), "statistics: it lacks 'steps'"),
        (lambda s: s.update(regularizer=3), "regularizer: expected finite tensors by name"),
        (lambda s: s["regularizer"].update(p=torch.tensor(math.nan)), "regularizer: expected finite tensors"),
        (lambda s: s["regularizer"].update(p=torch.tensor(0.5)), "regularizer: Error.*Chain"),
        (lambda s: s.update(step=2.0), "step must be a whole number from 0 to 5, got 2.0"),
        (lambda s: s.update(step=True), "step must be a whole number"),
        (lambda s: s.update(step=6), "step must be a whole number from 0 to 5, got 6"),
        (lambda s: s.update(seconds=math.nan), "seconds and processor_seconds must be positive numbers, got .nan"),
        (lambda s: s["fingerprints"].update(cameras=3), "fingerprints of cameras: expected float32"),
        (lambda s: s.update(config="{"), "damaged checkpoint: config is not JSON: Expecting"),
        (lambda s: s.update(config=3), "damaged checkpoint: "),
        (lambda s: s.update(config=json.dumps({"dropuot": 0.2})), r"unknown settings \['dropuot'\]"),
        (lambda s: s.update(config=json.dumps({"sh_degree": 1})), "step must be a whole|expected sh_degree 1, got 3"),
        (lambda s: s.update(gaussians=[1]), "gaussians: expected entries by name, got list"),
        (lambda s: s.update(moments=3), "moments: expected entries by name, got int"),
        (lambda s: s["gaussians"].update(means=3), "damaged checkpoint: "),
        (lambda s: s["gaussians"].update(means=torch.zeros(7, 3)), r"log_scales must have shape \(7, 3\)"),
        (lambda s: s["gaussians"].update(means=s["gaussians"]["means"].double()), "means: expected float32"),
        (
            lambda s: s["moments"]["means"].update(exp_avg=torch.zeros(3)),
            "moments of means, exp_avg: expected float32 of shape",
        ),
        (lambda s: s["statistics"].update(steps=torch.zeros(3)), r"steps: expected float32 of shape \(150,\)"),
        (lambda s: s["gaussians"]["means"].fill_(math.nan), "means: holds nan or infinity"),
        (lambda s: s["moments"]["sh_dc"]["exp_avg_sq"].fill_(math.inf), "moments of sh_dc, exp_avg_sq: holds nan"),
    ],
)
def test_an_entry_that_does_not_fit(saved, tiny_scene, tmp_path, change, said):
    refused(saved, tiny_scene, tmp_path, change, said)


def test_views_that_changed_under_their_names_are_not_trained_on(saved, tiny_scene, tmp_path):
    first, *others = tiny_scene.train
    moved = replace(first.camera, world_to_camera=first.camera.world_to_camera + 1e-3 * torch.eye(4, 4).roll(-1, 1))
    patched = first.image.clone()
    patched[:, :6, :6] = 1 - patched[:, :6, :6]
    for what, changed in (("cameras", replace(first, camera=moved)), ("photographs", replace(first, image=patched))):
        scene = replace(tiny_scene, train=(changed, *others))
        refused(saved, scene, tmp_path, lambda state: None, rf"other {what} of .*{first.name}'\]")
    # Another decoder rounds differently.
    rounded = replace(first, image=first.image + 1e-3 * torch.rand_like(first.image))
    assert Trainer.load(saved, replace(tiny_scene, train=(rounded, *others))).step == 2


@pytest.mark.parametrize("name", ["means", "sh_rest"])
def test_a_model_that_is_not_finite_does_not_replace_one_that_is(tiny_scene, tmp_path, name):
    path = tmp_path / "checkpoint.pt"
    trainer = Trainer(tiny_scene, TrainConfig(iterations=5))
    trainer.save(path)
    before = path.read_bytes()
    trainer.train(until=2)
    with torch.no_grad():
        getattr(trainer.gaussians, name)[3] = math.nan
    with pytest.raises(TrainingStoppedError, match=r"nan .*step 2, .*not saved"):
        trainer.save(path)
    assert path.read_bytes() == before


def keep(state: dict[str, Any], count: int) -> None:
    """Keep the first Gaussians everywhere."""
    for group in (state["gaussians"], state["statistics"], *state["moments"].values()):
        group.update({name: x[:count] if x.ndim else x for name, x in group.items()})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s.update(config="9" * 5000), "config is not JSON: Exceeds the limit"),
        (lambda s: s.update(config=["{}"]), "config must be JSON, got list"),
        (lambda s: s.update(config="[" * 100_000), "config is not JSON: maximum recursion"),
        (lambda s: s.update(config=json.dumps({"iterations": 5, "initial_scale": 1e300})), "config: distances must be"),
    ],
)
def test_settings_that_cannot_be_read_or_used(saved, tiny_scene, tmp_path, change, said):
    refused(saved, tiny_scene, tmp_path, change, said)


@pytest.mark.parametrize("change", [
    lambda s: s.update(moment=1), lambda s: s["gaussians"].update({3: torch.zeros(3)}),
    lambda s: s["statistics"].update(x=None), lambda s: s["moments"].update(colors={}),
    lambda s: s["moments"]["means"].update(max_exp_avg_sq=True),
])  # fmt: skip
def test_an_entry_that_nobody_wrote(saved, tiny_scene, tmp_path, change):
    refused(saved, tiny_scene, tmp_path, change, "unknown entry .*; it is damaged, or another version wrote it")


@pytest.mark.parametrize("empty", [None, False, 0, [], "", torch.zeros(0)])
def test_empty_moments_are_those_of_no_step(saved, tiny_scene, tmp_path, empty):
    said = "moments of means: expected entries by name, got"
    refused(saved, tiny_scene, tmp_path, lambda s: s["moments"].update(means=empty), said)


@pytest.mark.parametrize("shape", [(), (0, 3), (150,), (150, 3, 1)])
def test_means_of_another_shape(saved, tiny_scene, tmp_path, shape):
    refused(saved, tiny_scene, tmp_path, lambda s: s["gaussians"].update(means=torch.zeros(shape)), "")


@pytest.mark.parametrize("scene", [torch.zeros(3), ["synthetic"], "x" * 100_000])
def test_a_scene_of_another_kind_is_told_in_a_line(saved, tiny_scene, tmp_path, scene):
    for key, said in (("scene", "on the scene"), ("train_views", "was trained on the views")):
        refused(saved, tiny_scene, tmp_path, lambda s, key=key: s.update({key: scene}), said)
    state = load_checkpoint(saved) | {"scene": scene}
    save_checkpoint(tmp_path / "checkpoint.pt", state)
    with pytest.raises(ValueError, match="on the scene") as error:
        Trainer.load(tmp_path / "checkpoint.pt", tiny_scene)
    assert len(str(error.value)) < 400


def test_a_model_of_nothing_would_train_nothing(saved, tiny_scene, tmp_path):
    refused(saved, tiny_scene, tmp_path, lambda s: keep(s, 0), "gaussians: there is none to train")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s["moments"]["means"]["exp_avg_sq"][3].fill_(-1e-9), "exp_avg_sq: must not be below 0, got -1e-09"),
        (lambda s: s["moments"]["means"]["step"].fill_(-1.0), "step: must not be below 0, got -1"),
        (lambda s: s["moments"]["means"]["step"].fill_(1.5), "step: expected a whole number up to 2, got 1.5"),
        (lambda s: s["moments"]["means"]["step"].fill_(3.0), "step: expected a whole number up to 2, got 3"),
    ],
)
def test_numbers_that_would_be_nan_after_the_next_step(saved, tiny_scene, tmp_path, change, said):
    refused(saved, tiny_scene, tmp_path, change, said)


def alone(state: dict[str, Any]) -> None:
    """Say of every tensor that it wants a gradient."""
    for group in (state["gaussians"], state["statistics"], *state["moments"].values()):
        for x in group.values():
            x.requires_grad_()


def shared(state: dict[str, Any]) -> None:
    """Let two statistics share their memory; their content does not change."""
    state["statistics"]["steps"].fill_(0.5)
    state["statistics"]["gradient_sum"] = state["statistics"]["steps"]


@pytest.mark.parametrize("change", [alone, shared, lambda s: keep(s, 7)])
def test_the_next_steps_do_not_depend_on_how_tensors_were_stored(saved, tiny_scene, tmp_path, change):
    """What is counted up in place must not be counted twice, and cannot be where a gradient is wanted."""
    state = load_checkpoint(saved)
    change(state)
    save_checkpoint(tmp_path / "changed.pt", state)
    for group in (state["gaussians"], state["statistics"], *state["moments"].values()):
        group.update({name: x.detach().clone() for name, x in group.items()})
    save_checkpoint(tmp_path / "plain.pt", state)
    found = []
    for name in ("changed.pt", "plain.pt"):
        trainer = Trainer.load(tmp_path / name, tiny_scene)
        trainer.train()
        trainer.save(tmp_path / f"after_{name}")
        found.append({**load_checkpoint(tmp_path / f"after_{name}"), "seconds": 0, "processor_seconds": 0})
    one, other = (dict(tensors(state)) for state in found)
    assert one.keys() == other.keys()
    assert all(torch.equal(x, other[name]) for name, x in one.items())


def tensors(state: dict[str, Any]) -> Iterator[tuple[str, torch.Tensor]]:
    """Iterate over the tensors of a checkpoint with their places."""
    for name, x in state.items():
        if isinstance(x, dict):
            yield from ((f"{name}/{key}", y) for key, y in tensors(x))
        elif isinstance(x, torch.Tensor):
            yield name, x
