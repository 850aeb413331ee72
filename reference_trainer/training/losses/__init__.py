"""The terms of the training loss, and their registry: what ``--loss`` knows by name.

A term refuses arguments out of range with a ValueError, what should be a whole number with a TypeError; its `begin`
refuses a scene that lacks what it compares with, such as cameras that look to one side, with a ValueError.
"""

from ca_reg.registry import Registry
from ca_reg.schedules import SCHEDULES
from reference_trainer.training.losses.comparisons import CoAdaptation, Consistency, CoRegularization, StraightThrough
from reference_trainer.training.losses.depth import PatchDepth, Pearson, SmoothDepth, Warp
from reference_trainer.training.losses.distillation import Distillation
from reference_trainer.training.losses.penalties import Alpha, Flat, Opacity, RayExtent, Scale
from reference_trainer.training.losses.photometric import Photometric, Views
from reference_trainer.training.losses.term import LossTerm

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
    ray_extent=RayExtent,
    opacity=Opacity,
    co_adaptation=CoAdaptation,
    consistency=Consistency,
    straight_through=StraightThrough,
    co_regularization=CoRegularization,
    distillation=Distillation,
)
"""The terms by name; ``LOSSES.register("name")`` adds a class."""
