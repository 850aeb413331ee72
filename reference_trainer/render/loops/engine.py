"""The engine of compiled loops: float32 on a CPU, by hand-derived gradients, the same for any number of threads."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import check_projection
from reference_trainer.render.loops.binning import bin_gaussians
from reference_trainer.render.loops.drawing import composite
from reference_trainer.render.loops.moments import moments, shares
from reference_trainer.render.loops.projection import project, visible
from reference_trainer.render.splats import MomentImages, Splats

__all__ = ["LoopEngine"]


class LoopEngine:
    """See `Engine`."""

    name = "loops"

    def splat(self, inputs: dict[str, Tensor], camera: Camera, degree: int) -> Splats:
        """Cull, project, colour and list Gaussians."""
        means, opacities = inputs["means"], inputs["opacities"]
        colors = inputs["sh"] if "sh" in inputs else inputs["colors"][:, None]
        indices, finite = visible(means.detach(), opacities.detach(), camera)
        degree = degree if "sh" in inputs else -1
        projection, colors, drawable = project(
            means, inputs["quaternions"], inputs["scales"], colors, indices, camera, degree
        )
        check_projection(finite and drawable, projection, colors, inputs, camera)
        if indices.shape[0] < opacities.shape[0]:
            opacities = opacities.index_select(0, indices)
        lists = bin_gaussians(projection, opacities, camera.width, camera.height)
        return Splats(indices, projection, opacities, colors, lists, self)

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Keep the lists: the loops pass over those that are too faint."""
        return splats._replace(opacities=opacities)

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draw splats front to back; depth as the red of a second picture."""
        image, light = composite(splats, background)
        if not depth:
            return image, 1 - light, None
        red = torch.nn.functional.pad(splats.projection.depths[:, None], (0, 2))
        return image, 1 - light, composite(splats._replace(colors=red), torch.zeros_like(background))[0][0]

    def moments(self, splats: Splats, multiplier: Tensor, behind: Tensor) -> MomentImages:
        """Composite mean and variance back to front."""
        return moments(splats, multiplier, behind)

    def shares(self, splats: Splats, multiplier: Tensor, behind: Tensor, weights: Tensor) -> Tensor:
        """Sum the summands of the variance over the pixels."""
        return shares(splats, multiplier, behind, weights)
