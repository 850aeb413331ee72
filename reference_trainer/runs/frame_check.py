"""Check whether the cameras of a scene see a model trained elsewhere, that is, whether both share one frame."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from reference_trainer.model.gaussians import Gaussians
from reference_trainer.render.constants import MIN_ALPHA, NEAR_PLANE
from reference_trainer.scenes.scene import Scene

__all__ = ["check_frame"]

NEARLY_NONE = 0.01
"""Fraction of the Gaussians below which a camera counts as blind to a model: stray ones may be anywhere."""


def check_frame(gaussians: Gaussians, scene: Scene, name: str | Path) -> list[str]:
    """Count, before anything is rendered, the Gaussians that the cameras of a scene see.

    A Gaussian counts if its center is beyond the near plane (0.2) and inside the picture, and its opacity is at least
    1/255: fainter ones are never drawn.

    Args:
        gaussians: the model.
        scene: with the cameras, of both splits.
        name: of the model, for messages.

    Returns:
        Doubts: one line about the cameras that see less than 1 %, nothing if all see more.

    Raises:
        ValueError: if no Gaussian can be drawn, or all cameras together see less than 1 %.
    """
    drawn = gaussians[gaussians.opacities >= MIN_ALPHA]
    count, means = len(drawn), drawn.means
    if not count:
        raise ValueError(
            f"{name}: none of the {len(gaussians):,} Gaussians has an opacity of 1/255, all are invisible."
        )
    views = [*scene.train, *scene.test]
    before = torch.stack([view.camera.project(means)[1] >= NEAR_PLANE for view in views])
    inside = torch.stack([view.camera.inside(*view.camera.project(means)) for view in views]) & before
    seen = int(inside.any(0).sum())
    if seen < NEARLY_NONE * count:
        behind = int((~before).all(0).sum())
        center = means.double().median(0).values
        reach = (means - center).norm(dim=1).kthvalue(-(-98 * count // 100)).values  # without stray ones
        rig = torch.stack([view.camera.position for view in views]).double()
        forward = torch.stack([view.camera.forward for view in views]).double().mean(0)
        raise ValueError(
            f"the cameras of {scene.name} do not see {name}: of {count:,} Gaussians, {seen:,} ({seen / count:.2%}) are "
            f"in any of the {len(views)} pictures, {behind:,} are behind all cameras. The model lies around "
            f"{_text(center)} within {reach:.3g}; the cameras stand around {_text(rig.mean(0))} within "
            f"{(rig - rig.mean(0)).norm(dim=1).max():.3g} and look towards {_text(forward)} on average. Both must be "
            "in one frame: give the files that the model was trained with (see --format: COLMAP, LLFF and Blender "
            "files of one scene may differ in their frame), or leave out the scene for cameras on an orbit."
        )
    blind = [view.name for view, n in zip(views, inside.sum(1).tolist(), strict=True) if n < NEARLY_NONE * count]
    if not blind:
        return []
    return [f"{len(blind)} of {len(views)} cameras see less than {NEARLY_NONE:.0%} of {name}: {', '.join(blind)}."]


def _text(point: Tensor) -> str:
    """Return a point for a message."""
    return f"({', '.join(f'{x:.3g}' for x in point.tolist())})"
