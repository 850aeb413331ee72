"""Checkpoints: written atomically, read without executing anything."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from reference_trainer.files import replacing
from reference_trainer.tensor_files import load_tensors, moved

__all__ = ["load_checkpoint", "save_checkpoint"]

_FORMAT = "ca_reg-checkpoint-1"


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a state of tensors, numbers and strings; an interrupted write leaves the file that was there before.

    Tensors are written from the CPU, so that any machine can read them.

    Args:
        path: the file; its folder is created if missing.
        state: nested dicts and lists of tensors, numbers, strings and None.

    Raises:
        OSError: if the file cannot be written, as on a full disk; the error names it.
    """
    content = io.BytesIO()  # torch.save to a file hides the error of a full disk behind one of its own
    torch.save({"format": _FORMAT, **moved(state, "cpu")}, content)
    with replacing(path) as place:
        place.write_bytes(content.getbuffer())


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read what `save_checkpoint` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a checkpoint of this program, or damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint at {path}: train first, or give the path of a checkpoint.pt.")
    state = load_tensors(path, device, what="a readable checkpoint")
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise ValueError(f"{path} is not a checkpoint of this program (expected format {_FORMAT!r}).")
    return state
