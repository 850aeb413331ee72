"""Commands around training: poses of photographs, what options know by name, compilation, versions."""

from __future__ import annotations

import inspect
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reference_trainer.cli.options import Rendering, RenderOptions
from reference_trainer.runs.folder import check_writable

__all__ = ["Names", "Poses", "Recipes", "Version", "Warmup"]


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

    def check(self) -> None:
        if not self.photos.is_dir():
            raise FileNotFoundError(f"there is no folder {self.photos}: give the folder of the photographs.")
        check_writable(self.out or self.photos)

    def __call__(self) -> None:
        # Imported here, as in every command: torch takes seconds, and neither --help nor a mistyped path should wait.
        from reference_trainer.scenes.poses import find_poses

        found = find_poses(self.photos, self.out, camera=self.camera, seed=self.seed, progress=True)
        # The cameras are in <scene>/sparse/0.
        scene = found.folder.parents[1]
        out = shlex.quote(f"runs/{scene.resolve().name}")
        command = f"ca-reg train {shlex.quote(str(scene))} --recipe sparse --out {out}"
        print(f"{found}\nThe cameras are in {found.folder}. The best setting known for few photographs:\n  {command}")


@dataclass(frozen=True)
class Names:
    """List regularizers, losses, density control and renderers.

    By name and with arguments, for the options. Classes of your own need no entry: write module:Class.
    """

    what: Annotated[Literal["all", "regularizer", "loss", "density", "renderer"], tyro.conf.Positional] = "all"
    """Which option."""

    def __call__(self) -> None:
        from ca_reg.regularizers import REGULARIZERS
        from reference_trainer.renderers import RENDERERS
        from reference_trainer.training.density import DENSITY
        from reference_trainer.training.losses import LOSSES

        known: dict[str, Any] = {"regularizer": REGULARIZERS, "loss": LOSSES, "density": DENSITY, "renderer": RENDERERS}
        for option, registry in known.items():
            if self.what not in ("all", option):
                continue
            print(f"--{option}")
            for name in registry:
                made = registry[name]
                about = (inspect.getdoc(made) or "").partition("\n")[0]
                arguments = inspect.signature(made)
                # Without types: the user writes values, and the defaults show of what kind.
                bare = [each.replace(annotation=each.empty) for each in arguments.parameters.values()]
                print(f"  {name}{arguments.replace(parameters=bare, return_annotation=arguments.empty)}\n      {about}")


@dataclass(frozen=True)
class Recipes:
    """List the published methods that --recipe knows.

    With source, what each needs, and what differs from the original.
    """

    def __call__(self) -> None:
        from reference_trainer.training.recipes import RECIPES

        for name, recipe in RECIPES.items():
            print(f"{name}: {recipe.source}. Needs {recipe.needs}. Differs: {recipe.differs}.")


@dataclass(frozen=True)
class Warmup:
    """Compile the renderer's loops now, not at their first use.

    Needed once per machine and version.
    """

    rendering: Rendering = field(default_factory=RenderOptions)

    def __call__(self) -> None:
        from reference_trainer.runs.warmup import warm_up

        # Only the CPU has loops that can be compiled ahead, whatever card there is.
        self.rendering.begin("cpu")
        names = warm_up(points=True)
        print(f"Compiled: {', '.join(names)}." if names else "Nothing is left to compile.")


@dataclass(frozen=True)
class Version:
    """Print what a bug report should say: versions, processor, engine."""

    def __call__(self) -> None:
        from reference_trainer.evaluation.results import machine

        for name, value in machine().items():
            print(f"{name}: {value}")
