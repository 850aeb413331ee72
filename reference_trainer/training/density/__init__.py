"""Density control: the strategies and their registry: what ``--density`` knows by name.

A strategy refuses arguments out of range with a ValueError, what should be a whole number with a TypeError.
"""

from ca_reg.registry import Registry
from reference_trainer.training.density.adaptive import AbsGradDensity, AdaptiveDensity
from reference_trainer.training.density.growth import ProximityDensity, RayBoxDensity
from reference_trainer.training.density.mcmc import MCMCDensity
from reference_trainer.training.density.pruning import CoPruning, SelfEnsembling, SharePruning
from reference_trainer.training.model_state import DensityStrategy

__all__ = [
    "DENSITY", "AbsGradDensity", "AdaptiveDensity", "CoPruning", "DensityStrategy", "MCMCDensity",
    "ProximityDensity", "RayBoxDensity", "SelfEnsembling", "SharePruning",
]  # fmt: skip

DENSITY: Registry[DensityStrategy] = Registry(
    "density strategy",
    DensityStrategy,  # type: ignore[type-abstract]
    adaptive=AdaptiveDensity,
    absgrad=AbsGradDensity,
    proximity=ProximityDensity,
    mcmc=MCMCDensity,
    ray_boxes=RayBoxDensity,
    share_pruning=SharePruning,
    co_pruning=CoPruning,
    self_ensembling=SelfEnsembling,
)
"""The strategies by name; ``DENSITY.register("name")`` adds a class."""
