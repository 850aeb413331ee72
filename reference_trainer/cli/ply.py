"""Commands on PLY files: one class per command, whose fields are its options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from reference_trainer.cli.drawing import Device, Draw, Drawing
from reference_trainer.cli.places import Orbit, PlyScene, place_of
from reference_trainer.scenes.options import OrbitOptions, SceneOptions

__all__ = ["Bake", "Clean"]


@dataclass(frozen=True)
class Bake:
    """Give a PLY its test-time opacities, for other viewers.

    Other viewers do not know that after dropout p, for example, opacities are to be scaled by 1 - p. A comment in the
    file records that it was done.
    """

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY of a model that was trained with regularizers, opacities plain."""
    regularizer: str | None = None
    """What it was trained with, such as "dropout(0.2)"; PLYs of `ca-reg train` say so themselves."""
    out: Path | None = None
    """The file to write; by default <ply>_for_viewers.ply."""

    def __call__(self) -> None:
        from reference_trainer.runs.bake import bake_ply

        out = self.out or self.ply.with_name(f"{self.ply.stem}_for_viewers.ply")
        regularizer = bake_ply(self.ply, out, regularizer=self.regularizer)
        print(f"{out}: opacities are those of the test after {regularizer}, and marked so")


@dataclass(frozen=True)
class Clean:
    """Remove the Gaussians of a PLY that co-adapt most; refine.

    Most relative to what they contribute; prints a table of before and after. A few training steps on the photographs
    of the scene close the holes; without a scene, on an orbit, they stay. For models that were trained without a
    regularizer: after dropout there is little to remove.
    """

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY, opacities plain."""
    scene: Annotated[PlyScene, tyro.conf.arg(name="")] = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    fraction: float = 0.1
    """Fraction of the Gaussians to remove."""
    refine: int = 100
    """Training steps afterwards; 0 for none."""
    regularizer: str | None = None
    """What it was trained with, such as "dropout(0.2)"; PLYs of `ca-reg train` say so themselves."""
    out: Path | None = None
    """The file to write; by default <ply>_clean.ply."""
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.runs.clean import clean_ply

        place = place_of(self.ply, self.scene, self.orbit)
        if place is None:
            raise ValueError(f"{self.ply} is no PLY: give the point_cloud.ply of a run.")
        self.drawing.begin(self.device, trains=isinstance(place, SceneOptions))
        clean_ply(
            self.ply,
            place,
            self.out or self.ply.with_name(f"{self.ply.stem}_clean.ply"),
            fraction=self.fraction,
            refine=self.refine,
            background=self.scene.background,
            regularizer=self.regularizer,
            device=self.device,
        )
