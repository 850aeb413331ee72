"""The classes and the method that need nerfstudio; imported only by `ca_reg.integrations.nerfstudio`."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.models import splatfacto
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.plugins.types import MethodSpecification

from ._splatfacto import CoAdaptation

if not hasattr(splatfacto, "rasterization"):
    raise ImportError("its splatfacto does not call gsplat.rendering.rasterization; nerfstudio 1.1.1 and newer does")


@dataclass
class SplatfactoCAModelConfig(SplatfactoModelConfig):  # type: ignore[misc]
    """Splatfacto with dropout, opacity noise and the co-adaptation score."""

    _target: type = field(default_factory=lambda: SplatfactoCAModel)
    dropout: float = 0.2
    """share of the Gaussians left out of each training step; evaluation scales the opacities by 1 - dropout"""
    opacity_noise: float = 0.0
    """standard deviation of the relative noise on the opacities in training; the paper uses 0.8"""
    opacity_decay: float = 1.0
    """factor on all opacities after each step, from warmup_length on, such as 0.995; 1 leaves them as they are"""
    smooth_depth: float = 0.0
    """weight of kornia's inverse_depth_smoothness_loss in training, from warmup_length on, such as 0.1"""
    regularizer: str = ""
    """instead of these two, such as "dropout(0.2) + noise(0.8, scale=True)" or my_module:MyDropout; scored at p = 0"""
    ca_samples: int = 5
    """renders per evaluation image for the co-adaptation score; 0 leaves it out"""


class SplatfactoCAModel(CoAdaptation, SplatfactoModel):  # type: ignore[misc]
    """Splatfacto with regularized opacities and the co-adaptation score; see :class:`SplatfactoCAModelConfig`."""

    config: SplatfactoCAModelConfig
    holder = splatfacto

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[TrainingCallback]:
        """Return splatfacto's callbacks and, after them, the decay of opacities."""
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        own = TrainingCallback(after, self.decay_opacities)
        return [*super().get_training_callbacks(training_callback_attributes), own]


def make_method() -> MethodSpecification:
    """Return splatfacto's own method with only the model replaced."""
    # Not at the top: nerfstudio loads this while it imports that module, after filling the dictionary.
    from nerfstudio.configs.method_configs import method_configs

    config = deepcopy(method_configs["splatfacto"])
    config.method_name = "splatfacto-ca"
    plain = vars(config.pipeline.model)
    config.pipeline.model = SplatfactoCAModelConfig(**{**plain, "_target": SplatfactoCAModel})
    return MethodSpecification(config, "Splatfacto with Gaussian dropout, opacity noise and the co-adaptation score")


# Saved runs refer to classes by module: use the public one, which will not move.
for _class in (SplatfactoCAModelConfig, SplatfactoCAModel):
    _class.__module__ = "ca_reg.integrations.nerfstudio"
