"""The engine of tensor operations: any dtype, any device; what the loops are tested against."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import check_projection
from reference_trainer.render.constants import MIN_ALPHA, NEAR_PLANE
from reference_trainer.render.eager import formulas
from reference_trainer.render.eager.binning import bin_gaussians
from reference_trainer.render.eager.projection import project
from reference_trainer.render.eager.spherical_harmonics import evaluate_sh
from reference_trainer.render.eager.walk import blocks, geometry_rows, pad_entries, pixel_offsets, tile, walk
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
        """Differentiate block after block; these are made now: the backward pass is to wait for nothing."""
        rows = pad_entries(torch.cat([geometry_rows(splats), values.T]))
        of_lists, pixels = list(blocks(splats.lists, rows.device)), pixel_offsets(rows)

        def sums(gradient: Tensor) -> Tensor:
            upstream, total = tile(gradient, splats.lists), rows.new_zeros(2, rows.shape[1])
            for block in of_lists:
                entries = rows[:, block.gaussians]
                raw = block.alphas(entries[:6]).requires_grad_()
                with torch.enable_grad():
                    drawn = formulas.over(formulas.blend_weights(raw), entries[6:], background[:, None])
                (to_raw,) = torch.autograd.grad(drawn, raw, upstream[block.tiles])
                # ln alpha falls by half the square of (l11 dx + l21 dy, l22 dy); its gradient in the position is that
                # of alpha divided by alpha.
                x, y, l11, l21, l22 = entries[:5, :, None]
                dx, dy = pixels[0] + block.centers[0][..., None] - x, pixels[1] + block.centers[1][..., None] - y
                w1, w2 = l11 * dx + l21 * dy, l22 * dy
                slopes = raw.detach() * to_raw * torch.stack([l11 * w1, l21 * w1 + l22 * w2])
                total.index_add_(1, block.gaussians.flatten(), slopes.abs().sum(2).flatten(1))
            return total[:, :-1].T

        return sums

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
