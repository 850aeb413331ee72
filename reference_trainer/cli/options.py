"""Options that commands share: the rendering engine, the views of a model, what a folder may import; and their checks.

Nothing here imports torch, which takes seconds: a mistyped path is answered before that.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reference_trainer.files import is_ply
from reference_trainer.runs.folder import CONFIG, check_output, check_run, read_run_settings
from reference_trainer.scenes.options import OrbitOptions, SceneOptions, check_scene

__all__ = [
    "Device", "Orbit", "PlyScene", "RenderOptions", "Rendering", "Trust", "check_model", "check_out", "check_ply",
    "scene_or_orbit",
]  # fmt: skip

Device = Annotated[str, tyro.conf.arg(help='"cpu" or "cuda".')]
Orbit = Annotated[OrbitOptions, tyro.conf.arg(name="orbit")]
Trust = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        help="Modules of your own that a run or a PLY names (my_module:MyDropout) and that may be imported: what a "
        "file from elsewhere names is not executed."
    ),
]


@dataclass(frozen=True)
class RenderOptions:
    """The rendering engine, for all commands that render."""

    engine: Literal["auto", "numba", "torch", "triton"] | None = None
    """What renders: "numba" (compiled; float32 on a CPU), "torch" (anything), "triton" (float32 on a CUDA card), or
    "auto", whichever fits. By default $CA_REG_ENGINE, or "auto"."""

    def choose(self, device: str) -> None:
        """Choose the engine of this process and its workers, or refuse it with a ValueError."""
        from reference_trainer.render import chosen_engine, use_engine

        if self.engine == "triton" and device == "cpu" and os.environ.get("TRITON_INTERPRET") != "1":
            raise ValueError(
                "the engine triton renders on a card, not on cpu: give --device cuda or another engine "
                "(TRITON_INTERPRET=1 interprets its kernels on a processor, slowly)."
            )
        use_engine(self.engine) if self.engine is not None else chosen_engine()

    def begin(self, device: str, *, trains: bool = False, points: bool = False) -> None:
        """Choose the engine of this process and its workers, and print which it is.

        One that ``trains`` needs all loops but those that measure ``points``: what is not compiled yet is compiled now,
        with progress. Raises a ValueError for triton on a processor, unless its interpreter is asked for.
        """
        import torch

        from reference_trainer.render import describe_engine

        self.choose(device)
        hint = "; a CUDA card is here: --device cuda uses it" if device == "cpu" and torch.cuda.is_available() else ""
        print(f"Engine: {describe_engine(device)}{hint}", flush=True)
        if trains and device == "cpu":
            from reference_trainer.runs.warmup import warm_up

            warm_up(points=points)


Rendering = Annotated[RenderOptions, tyro.conf.arg(name="rendering")]


@dataclass(frozen=True)
class PlyScene(SceneOptions):
    """The scene of a PLY, if it has one."""

    path: Annotated[str, tyro.conf.arg(aliases=("--scene",))] = "orbit"
    """For a PLY: scene folder, "synthetic" for the built-in scene, or "orbit" for cameras around the model."""
    init: Annotated[str | None, tyro.conf.Suppress] = None  # the PLY is the model


def scene_or_orbit(source: Path, scene: PlyScene, orbit: OrbitOptions) -> SceneOptions | OrbitOptions | None:
    """Return the scene or orbit of a PLY; None for the folder of a run, which has its own scene.

    Options that do not apply are refused with a ValueError.
    """
    if not is_ply(source):
        if (scene, orbit) != (PlyScene(), OrbitOptions()):
            raise ValueError(
                f"{source} is no PLY, and a run is looked at on its own scene: leave out options of scene and orbit."
            )
        return None
    if scene.path == "orbit":
        # No PLY says over which color it was trained, so this option applies to an orbit as well.
        if replace(scene, background="auto") != PlyScene():
            raise ValueError("without photographs no option of a scene but --background applies: give --scene.")
        return orbit
    if orbit != OrbitOptions():
        raise ValueError(f"the options of an orbit do not apply to the scene {scene.path}: leave out them, or --scene.")
    return scene


def check_model(source: Path, where: SceneOptions | OrbitOptions | None) -> None:
    """Refuse a run, a PLY or its scene that is not there, with a FileNotFoundError that says what was expected."""
    if where is None:
        check_run(source)
    elif not source.is_file():
        raise FileNotFoundError(f"there is no file {source}: expected a standard 3DGS .ply, or the folder of a run.")
    elif isinstance(where, SceneOptions):
        check_scene(where.path)


def check_ply(source: Path) -> None:
    """Refuse the folder of a run, or another file, where a command takes a PLY alone, with a ValueError."""
    if not is_ply(source):
        raise ValueError(f"{source} is no PLY: give one, such as the point_cloud.ply of a run.")


def check_out(out: Path | None, source: Path, where: SceneOptions | OrbitOptions | None = None) -> None:
    """Refuse, with a ValueError, to write into the photographs of a run, or of a PLY, given its `scene_or_orbit`."""
    if out is not None:
        # Only its settings say where the photographs of a run are.
        scene = read_run_settings(source / CONFIG)[0] if where is None else where
        check_output(out, scene.path if isinstance(scene, SceneOptions) else None, ())
