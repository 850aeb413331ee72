"""Density strategies, and Gaussians for them to work on."""

import dataclasses
import math

import torch

from reference_trainer.model.gaussians import PARAMETERS, Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import DENSITY, DensityStrategy

__all__ = ["begun", "short", "some", "stepped"]


def some(n: int, seed: int = 0, size: float = 0.1) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,)}
    tensors = {name: torch.randn(*shape, generator=g) for name, shape in shapes.items()}
    tensors["log_scales"] += math.log(size)
    colors = {"sh_dc": torch.randn(n, 1, 3, generator=g), "sh_rest": torch.randn(n, 3, 3, generator=g)}
    return Gaussians(**tensors, **colors)


def stepped(gaussians: Gaussians) -> GaussianOptimizer:
    """An optimizer whose moments are not zero."""
    optimizer = GaussianOptimizer(gaussians, dict.fromkeys(PARAMETERS, 1e-3))
    sum((x.square() * (1 + torch.arange(len(x)).view(-1, *[1] * (x.ndim - 1)))).sum() for _, x in
        optimizer.gaussians.named()).backward()  # fmt: skip
    optimizer.step()
    return optimizer


def begun(expression: str, scene, count: int, **settings) -> DensityStrategy:
    strategy = DENSITY.make_one(expression)
    strategy.begin(TrainConfig(**settings), scene, torch.device("cpu"), count)
    return strategy


def short(config: TrainConfig, expression: str, iterations: int) -> TrainConfig:
    """Settings with this density control, and as many models as it compares."""
    models = 2 if "models" in DENSITY.make_one(expression).needs else 1
    return dataclasses.replace(config, density=expression, iterations=iterations, prune_size=None, models=models)
