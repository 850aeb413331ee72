import os
import pickle

import pytest
import torch

from reference_trainer.training.checkpoint import load_checkpoint, save_checkpoint

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
        pytest.raises(OSError, match=r"what was there before is kept.*checkpoint\.pt"),
    ):
        save_checkpoint(path, {"x": torch.zeros(100_000)})
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint at .*nowhere\.pt"):
        load_checkpoint(tmp_path / "nowhere.pt")


@pytest.mark.parametrize("content", [b"", b"garbage", bytes(range(256)) * 4, b"PK\x03\x04" + bytes(99)])
def test_garbage_is_refused_by_name(tmp_path, content):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.pt is not a readable checkpoint"):
        load_checkpoint(path)


def test_a_cut_file_is_refused_by_name(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, STATE)
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"checkpoint\.pt is not a readable checkpoint"):
            load_checkpoint(path)


@pytest.mark.parametrize("content", [{"step": 3}, torch.zeros(3), {"format": "another program"}])
def test_files_of_other_programs(tmp_path, content):
    path = tmp_path / "other.pt"
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"other\.pt is not a checkpoint of this program"):
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
    with pytest.raises(ValueError, match=r"evil\.pt is not a readable checkpoint"):
        load_checkpoint(path)
    assert not target.exists()
