"""The Gaussians that training starts from: made of the scene's points, or those of a model."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from ca_reg.neighbors import rms_neighbor_distance
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import arguments
from reference_trainer.render import splat
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.config import TrainConfig

__all__ = ["drawn_by_any", "initial_gaussians"]


def initial_gaussians(scene: Scene, config: TrainConfig) -> Gaussians:
    """Make one isotropic Gaussian per point, as wide as the distance to its neighbors times ``config.initial_scale``.

    If the scene has a model to start from, its Gaussians are taken as they are, their spherical harmonics cut or padded
    with zeros to ``config.sh_degree``.

    Args:
        scene: with its initial points or model.
        config: says which points to take and how large and how opaque the Gaussians are.

    Raises:
        ValueError: if only seen points are to be taken and there are none.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> scene = synthetic_scene(width=16, height=12, points=50)
        >>> len(initial_gaussians(scene, TrainConfig()))
        50
    """
    if scene.start is not None:
        bands = (config.sh_degree + 1) ** 2 - 1
        rest = scene.start.sh_rest[:, :bands]
        start = replace(scene.start, sh_rest=pad(rest, (0, 0, 0, bands - rest.shape[1])))
    else:
        start = Gaussians.from_points(
            scene.points.positions,
            scene.points.colors,
            rms_neighbor_distance(scene.points.positions) * config.initial_scale,
            sh_degree=config.sh_degree,
            opacity=config.initial_opacity,
        )
    if config.initial_points == "all":
        return start
    seen = drawn_by_any(start, scene.train)
    if not bool(seen.any()):
        raise ValueError(
            f"no initial Gaussian of scene {scene.name!r} has a pixel in a training view: give other points."
        )
    return start[seen]


@torch.no_grad()
def drawn_by_any(gaussians: Gaussians, views: tuple[View, ...]) -> Tensor:
    """Return which Gaussians have a pixel in some view, shape (N,), bool. The others never receive a gradient."""
    drawn = torch.zeros(len(gaussians), dtype=torch.bool)
    for view in views:
        splats = splat(**arguments(gaussians), camera=view.camera, sh_degree=0)
        drawn[splats.indices[splats.touched]] = True
    return drawn
