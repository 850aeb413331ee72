"""Commands that list the known names, the recipes, and the installed versions."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

__all__ = ["Names", "Recipes", "Version"]


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
class Version:
    """Print what a bug report should say: versions, processor, engine."""

    def __call__(self) -> None:
        from reference_trainer.evaluation.results import machine

        for name, value in machine().items():
            print(f"{name}: {value}")
