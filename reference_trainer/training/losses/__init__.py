"""The terms of the training loss, one per file, and their registry: what ``--loss`` knows by name."""

from ca_reg.registry import Registry
from ca_reg.schedules import SCHEDULES
from reference_trainer.training.losses.alpha import Alpha
from reference_trainer.training.losses.co_adaptation import CoAdaptation
from reference_trainer.training.losses.co_regularization import CoRegularization
from reference_trainer.training.losses.consistency import Consistency
from reference_trainer.training.losses.flat import Flat
from reference_trainer.training.losses.opacity import Opacity
from reference_trainer.training.losses.patch_depth import PatchDepth
from reference_trainer.training.losses.pearson import Pearson
from reference_trainer.training.losses.photometric import Photometric
from reference_trainer.training.losses.scale import Scale
from reference_trainer.training.losses.smooth_depth import SmoothDepth
from reference_trainer.training.losses.straight_through import StraightThrough
from reference_trainer.training.losses.term import LossTerm
from reference_trainer.training.losses.views import Views
from reference_trainer.training.losses.warp import Warp

__all__ = ["LOSSES", "CoAdaptation", "Consistency", "LossTerm", "Photometric"]

LOSSES: Registry[LossTerm] = Registry(
    "loss term",
    LossTerm,  # type: ignore[type-abstract]
    SCHEDULES,
    photometric=Photometric,
    views=Views,
    pearson=Pearson,
    patch_depth=PatchDepth,
    warp=Warp,
    smooth_depth=SmoothDepth,
    alpha=Alpha,
    flat=Flat,
    scale=Scale,
    opacity=Opacity,
    co_adaptation=CoAdaptation,
    consistency=Consistency,
    straight_through=StraightThrough,
    co_regularization=CoRegularization,
)
"""The terms by name; ``LOSSES.register("name")`` adds a class."""
