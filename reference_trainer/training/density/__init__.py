"""Density control: the strategies, one per file, and their registry: what ``--density`` knows by name."""

from ca_reg.registry import Registry
from reference_trainer.training.density.absgrad import AbsGradDensity
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.co_pruning import CoPruning
from reference_trainer.training.density.mcmc import MCMCDensity
from reference_trainer.training.density.proximity import ProximityDensity
from reference_trainer.training.density.ray_boxes import RayBoxDensity
from reference_trainer.training.density.self_ensembling import SelfEnsembling
from reference_trainer.training.density.share_pruning import SharePruning
from reference_trainer.training.density.strategy import DensityStrategy

__all__ = [
    "DENSITY",
    "AbsGradDensity",
    "AdaptiveDensity",
    "CoPruning",
    "DensityStrategy",
    "MCMCDensity",
    "ProximityDensity",
    "RayBoxDensity",
    "SelfEnsembling",
    "SharePruning",
]

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
