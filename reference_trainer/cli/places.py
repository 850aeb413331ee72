"""The views at which a model is measured or shown: of a run's own scene, of a PLY's scene, or on an orbit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from reference_trainer.files import is_ply
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
    """Return the scene or orbit of a PLY; None for the folder of a run, which has its own scene.

    Raises:
        ValueError: if options are given that do not apply.
    """
    if not is_ply(source):
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
