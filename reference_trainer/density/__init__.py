"""Density control: strategies, one file each, and their registry: what ``--density`` knows by name."""

from ca_reg.registry import Registry
from reference_trainer.density.adaptive import AdaptiveDensity
from reference_trainer.density.strategy import DensityStrategy

__all__ = ["DENSITY", "AdaptiveDensity", "DensityStrategy"]

DENSITY: Registry[DensityStrategy] = Registry("density strategy", DensityStrategy)  # type: ignore[type-abstract]
"""What can be asked for by name; ``DENSITY.register("name")`` adds a class."""

DENSITY.register("adaptive")(AdaptiveDensity)
