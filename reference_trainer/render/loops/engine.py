"""The engine of compiled loops: float32 on a CPU, by hand-derived gradients, the same for any number of threads."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import check_projection
from reference_trainer.render.loops.binning import bin_gaussians
from reference_trainer.render.loops.drawing import absolute_gradients, composite, composite_masks
from reference_trainer.render.loops.moments import moments, shares
from reference_trainer.render.loops.projection import project, visible
from reference_trainer.render.splats import Splats

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
        light, image = torch.split(composite(splats, background), [1, 3])
        if not depth:
            return image, 1 - light[0], None
        red = torch.nn.functional.pad(splats.projection.depths[:, None], (0, 2))
        return image, 1 - light[0], composite(splats._replace(colors=red), torch.zeros_like(background))[1]

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw all in one pass: what does not depend on the opacity is evaluated once."""
        drawn = composite_masks(splats, opacities, background)
        return drawn[:, 1:], 1 - drawn[:, 0]

    absolute_gradients = staticmethod(absolute_gradients)
    moments = staticmethod(moments)
    shares = staticmethod(shares)
