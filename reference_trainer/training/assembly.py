"""From settings to what they ask for: the expressions of a `TrainConfig` made, and checked against each other."""

from __future__ import annotations

from ca_reg import Chain
from ca_reg.regularizers import parse
from reference_trainer.renderers import RENDERERS, Renderer
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import DENSITY, DensityStrategy
from reference_trainer.training.losses import LOSSES, LossTerm

__all__ = ["check", "draws_background", "make_density", "make_losses", "make_regularizer", "make_renderer"]


def make_regularizer(config: TrainConfig) -> Chain:
    """Make the regularizers; empty if there are none."""
    return parse(config.regularizers)


def make_losses(config: TrainConfig) -> list[LossTerm]:
    """Make the terms of the loss."""
    return LOSSES.make(config.loss)


def make_density(config: TrainConfig, index: int = 0) -> DensityStrategy:
    """Make the density control of one of the models."""
    density = DENSITY.make_one(config.density)
    density.index = index
    return density


def make_renderer(config: TrainConfig) -> Renderer:
    """Make the renderer of the training views."""
    return RENDERERS.make_one(config.renderer)


def draws_background(config: TrainConfig, scene: Scene) -> bool:
    """Return whether the steps lie over random colors."""
    return config.random_background == "on" or (config.random_background == "auto" and not scene.shows_background)


def check(config: TrainConfig) -> None:
    """Raise a ValueError unless all expressions are valid and what they name goes together."""
    # Making them is the check of the expressions; each error names what is known instead.
    make_regularizer(config)
    density, renderer, terms = make_density(config), make_renderer(config), make_losses(config)
    if not terms:
        raise ValueError("loss needs at least one term, such as photometric.")
    of_terms = frozenset[str]().union(*(term.needs for term in terms))
    if config.models < 2 and "models" in density.needs | of_terms:
        raise ValueError(f"{config.loss} with {config.density} compares models, of which there is one: set models=2.")
    if config.analytic and "moments" not in renderer.capabilities:
        raise ValueError("analytic training needs the moments of the builtin renderer: leave out renderer.")
    if config.analytic and "absgrad" in density.needs:
        raise ValueError(f"analytic training has no absolute gradients, which {config.density} needs: leave it out.")
    for what, needs in ((config.density, density.needs), ("the loss", of_terms)):
        if lacking := ", ".join(sorted(needs - renderer.capabilities - {"models"})):
            raise ValueError(f"{what} needs {lacking}, which the renderer {config.renderer} lacks.")
    if config.analytic and (sampled := [type(term).__name__ for term in terms if not term.analytic]):
        raise ValueError(
            f"analytic training has no draw, which {', '.join(sampled)} needs: leave out analytic, or the term."
        )
