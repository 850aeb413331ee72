"""Commands about PLY files. One class per command, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["Bake"]


@dataclass(frozen=True)
class Bake:
    """Scale the opacities of a PLY by 1 - p, for viewers that know nothing of dropout; a comment in it says so."""

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY of a model that was trained with dropout, opacities plain."""
    dropout: float
    """The rate p of the training."""
    out: Path | None = None
    """The file to write; by default <ply>_for_viewers.ply."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.model.bake import bake_ply

        out = self.out or self.ply.with_name(f"{self.ply.stem}_for_viewers.ply")
        bake_ply(self.ply, out, dropout=self.dropout)
        print(f"{out}: opacities are scaled by {1 - self.dropout:g}, and marked so")
