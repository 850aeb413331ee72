"""Where a model is looked at: on the scene of a run, or of a PLY, which may have none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from reference_trainer.scenes.options import OrbitOptions, SceneOptions

__all__ = ["Orbit", "PlyScene", "place_of"]

Orbit = Annotated[OrbitOptions, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class PlyScene(SceneOptions):
    """The scene of a PLY, if it has one."""

    path: Annotated[str, tyro.conf.arg(aliases=("--scene",))] = "orbit"
    """For a PLY: scene folder, "synthetic" for the built-in scene, or "orbit" for cameras around the model."""
    init: Annotated[str | None, tyro.conf.Suppress] = None  # the PLY is the model


def place_of(source: Path, scene: PlyScene, orbit: OrbitOptions) -> SceneOptions | OrbitOptions | None:
    """Return where a PLY is looked at; None for the folder of a run, which has a scene of its own.

    Raises:
        ValueError: if options were given that do not apply.
    """
    if source.is_dir() or source.suffix.lower() != ".ply":
        if (scene, orbit) != (PlyScene(), OrbitOptions()):
            raise ValueError(
                f"{source} is no PLY, and a run is looked at on its own scene: leave out options of scene and orbit."
            )
        return None
    if scene.path == "orbit":
        if replace(scene, background="auto") != PlyScene():
            raise ValueError("without photographs no option of a scene but --background applies: give --path.")
        return orbit
    if orbit != OrbitOptions():
        raise ValueError(f"the options of an orbit do not apply to the scene {scene.path}: leave them, or --path, out.")
    return scene
