"""Commands about PLY files. One class per command, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

__all__ = ["Bake"]


@dataclass(frozen=True)
class Bake:
    """Give a PLY its test-time opacities, such as times 1 - p after dropout p, for viewers that know of no regularizer.

    A comment in the file says so.
    """

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY of a model that was trained with regularizers, opacities plain."""
    regularizer: str | None = None
    """What it was trained with, such as "dropout(0.2)"; PLYs of `ca-reg train` say so themselves."""
    out: Path | None = None
    """The file to write; by default <ply>_for_viewers.ply."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.runs.bake import bake_ply

        out = self.out or self.ply.with_name(f"{self.ply.stem}_for_viewers.ply")
        regularizer = bake_ply(self.ply, out, regularizer=self.regularizer)
        print(f"{out}: opacities are those of the test after {regularizer}, and marked so")
