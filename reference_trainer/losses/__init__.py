"""The terms of the training loss, one file each, and their registry: what ``--loss`` knows by name."""

from ca_reg.registry import Registry
from reference_trainer.losses.co_adaptation import CoAdaptation
from reference_trainer.losses.consistency import Consistency
from reference_trainer.losses.photometric import Photometric
from reference_trainer.losses.term import LossTerm

__all__ = ["LOSSES", "CoAdaptation", "Consistency", "LossTerm", "Photometric"]

LOSSES: Registry[LossTerm] = Registry("loss term", LossTerm)  # type: ignore[type-abstract]
"""What can be asked for by name; ``LOSSES.register("name")`` adds a class."""

LOSSES.register("photometric")(Photometric)
LOSSES.register("co_adaptation")(CoAdaptation)
LOSSES.register("consistency")(Consistency)
