"""The command that finds the cameras of photographs; its fields are its options."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["Poses"]


@dataclass(frozen=True)
class Poses:
    """Find the cameras of photographs that have none, by COLMAP.

    Writes sparse/0 beside them, for training, and says which photographs were registered. Needs ca_reg[colmap].
    """

    photos: Annotated[Path, tyro.conf.Positional]
    """Folder of the photographs, at least two."""
    out: Path | None = None
    """Another scene folder to write to, with copies of the photographs; by default theirs."""
    camera: str | None = None
    """COLMAP's camera model, such as OPENCV; by default SIMPLE_PINHOLE below 8 photographs, else SIMPLE_RADIAL."""
    seed: int = 0
    """Seed of all randomness."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.scenes.poses import find_poses

        found = find_poses(self.photos, self.out, camera=self.camera, seed=self.seed, progress=True)
        command = shlex.join(["ca-reg", "train", str(found.folder.parents[1])])
        print(f"{found}\nThe cameras are in {found.folder}: {command}")
