"""One model in training: its Gaussians, and everything that changes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from ca_reg import Chain
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import DensityStrategy
from reference_trainer.training.initial import initial_gaussians

__all__ = ["ModelState"]


class ModelState:
    """Gaussians with an optimizer, density control and regularizers of their own; a training has one, or several.

    All models of a training start from the same points and diverge by their random numbers: every model has its own for
    the splits of density control and for the draws of regularizers and loss terms.

    Args:
        scene: with the points to start from.
        config: all settings.
        density: its density control; prepared here.
        regularizer: its regularizers.
        device: where to train.
        index: which of the models it is; the first, 0, is the one that is measured and written.

    Attributes:
        label: prefix of the labels of the model's random streams.

    Raises:
        ValueError: as `initial_gaussians`.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>>         >>> scene, config = synthetic_scene(width=16, height=12, points=50), TrainConfig()
        >>> state = ModelState(scene, config, make_density(config), make_regularizer(config))
        >>> len(state.gaussians)
        50
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        density: DensityStrategy,
        regularizer: Chain,
        *,
        device: torch.device | str = "cpu",
        index: int = 0,
    ) -> None:
        # The label names random streams: with another word than "field", trainings would come out differently.
        self.label = f"field {index}/" if index else ""
        self.regularizer = regularizer
        learns, start = regularizer.learns, initial_gaussians(scene, config)
        known = start.learned  # of a model with the same regularizers
        learned = {name: known.get(name, torch.full((len(start),), x.start)) for name, x in learns.items()}
        start = replace(start, learned=learned)
        rates = {
            "means": config.means_rate_at(0) * scene.extent,
            "log_scales": config.scales_rate,
            "quaternions": config.quaternions_rate,
            "opacity_logits": config.opacity_rate,
            "sh_dc": config.color_rate,
            "sh_rest": config.color_rate / 20,
            **{name: learned.rate for name, learned in learns.items()},
        }
        self.optimizer = GaussianOptimizer(start.to(device), rates)
        self.density = density
        density.begin(config, scene, torch.device(device), len(start))

    @property
    def gaussians(self) -> Gaussians:
        """The model as it stands."""
        return self.optimizer.gaussians

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, as nested dicts of tensors."""
        found = {"statistics": self.density.state_dict(), "regularizer": dict(self.regularizer.state_dict())}
        return found | self.optimizer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: if the regularizers refuse their part.
        """
        self.optimizer.load_state_dict(dict(state))
        self.density.reset(len(self.gaussians))
        self.density.load_state_dict(state["statistics"])
        try:
            self.regularizer.load_state_dict(state["regularizer"])
        except RuntimeError as error:
            raise ValueError(str(error)) from error
