"""The engine of tensor operations: any dtype, any device; what the loops are tested against."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import check_projection
from reference_trainer.render.constants import MIN_ALPHA, NEAR_PLANE
from reference_trainer.render.eager import formulas
from reference_trainer.render.eager.absolute import absolute_gradients
from reference_trainer.render.eager.binning import bin_gaussians
from reference_trainer.render.eager.projection import project
from reference_trainer.render.eager.spherical_harmonics import evaluate_sh
from reference_trainer.render.eager.walk import blocks, geometry_rows, walk
from reference_trainer.render.splats import MomentImages, Splats

__all__ = ["TorchEngine"]


class TorchEngine:
    """See `Engine`."""

    name = "torch"

    def splat(self, inputs: dict[str, Tensor], camera: Camera, degree: int) -> Splats:
        """Cull, project, colour and list Gaussians."""
        with torch.no_grad():
            depths = inputs["means"] @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
            culled_by = depths.sum() + inputs["opacities"].sum()
            indices = torch.nonzero((depths > NEAR_PLANE) & (inputs["opacities"] >= MIN_ALPHA)).squeeze(1)
        drawn = inputs
        if indices.shape[0] < depths.shape[0]:
            drawn = {name: x.index_select(0, indices) for name, x in inputs.items()}
        projection = project(drawn["means"], drawn["quaternions"], drawn["scales"], camera)
        if "sh" in drawn:
            directions = torch.nn.functional.normalize(drawn["means"] - camera.position, dim=-1)
            colors = evaluate_sh(drawn["sh"], directions, degree)
        else:
            colors = drawn["colors"]
        # A sum is not finite if one of its summands is not; one wait for a GPU.
        total = sum((x.detach().sum() for x in (projection.means, projection.covariances, colors)), culled_by)
        check_projection(bool(total.isfinite()), projection, colors, inputs, camera)
        with torch.no_grad():
            lists = bin_gaussians(projection, drawn["opacities"], camera.width, camera.height)
        return Splats(indices, projection, drawn["opacities"], colors, lists, self)

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Take those that are too faint out of the lists."""
        return splats._replace(opacities=opacities, lists=splats.lists.only(opacities >= MIN_ALPHA))

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draw splats front to back."""
        values = [splats.colors.T, splats.projection.depths[None]] if depth else [splats.colors.T]
        shape = (splats.lists.height, splats.lists.width)
        behind = torch.nn.functional.pad(background, (0, len(values) - 1))[:, None, None].expand(-1, *shape)
        rows = torch.cat([geometry_rows(splats), *values])
        sums = walk(formulas.composite, rows, behind, splats.lists, extra=1)
        return sums[:3], sums[-1], sums[3] if depth else None

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw one after the other."""
        drawn = (self.composite(self.masked(splats, row), background, depth=False) for row in opacities)
        images, alphas, _ = zip(*drawn, strict=True)
        return torch.stack(images), torch.stack(alphas)

    def absolute_gradients(
        self, splats: Splats, values: Tensor, background: Tensor, _drawn: Tensor
    ) -> Callable[[Tensor], Tensor]:
        """Take the blocks of the lists now: the backward pass is to wait for nothing."""
        tiles = list(blocks(splats.lists, values.device))
        return lambda gradient: absolute_gradients(splats, values, gradient, background, tiles)

    def moments(self, splats: Splats, multiplier: Tensor, behind: Tensor) -> MomentImages:
        """Composite mean and variance back to front."""
        one = torch.ones_like(splats.opacities)[None]
        return self._moments(splats, multiplier, behind, one)

    def shares(self, splats: Splats, multiplier: Tensor, behind: Tensor, weights: Tensor) -> Tensor:
        """Return the gradients of the variance in factors of its summands."""
        with torch.enable_grad():
            factors = torch.ones_like(splats.opacities)[None].requires_grad_()
            variance = self._moments(splats, multiplier, behind, factors).variance
            total = (variance.mean(0) * weights).sum()
        return torch.autograd.grad(total, factors)[0][0].double()

    def _moments(self, splats: Splats, multiplier: Tensor, behind: Tensor, factors: Tensor) -> MomentImages:
        rows = torch.cat([geometry_rows(splats), multiplier.T, factors, splats.colors.T])
        images = walk(formulas.moments, rows, behind, splats.lists, extra=4)
        return MomentImages(images[:3], images[3:6], images[6])
