"""The engine of PyTorch operations, for any dtype and device; the loops are tested against it."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.constants import MIN_ALPHA
from reference_trainer.render.splats import MomentImages, Projection, Splats
from reference_trainer.render.torch import formulas
from reference_trainer.render.torch.binning import bin_gaussians
from reference_trainer.render.torch.projection import project
from reference_trainer.render.torch.spherical_harmonics import evaluate_sh
from reference_trainer.render.torch.walk import blocks, geometry_rows, pad_entries, pixel_offsets, tile, walk

__all__ = ["TorchEngine"]


class TorchEngine:
    """See `Engine`."""

    name = "torch"

    def project(
        self, inputs: dict[str, Tensor], indices: Tensor, camera: Camera, degree: int | None
    ) -> tuple[Projection, Tensor]:
        """Project and color Gaussians."""
        if degree is not None:
            inputs = inputs | {"sh": inputs["sh"][:, : (degree + 1) ** 2]}
        if indices.shape[0] < inputs["means"].shape[0]:
            inputs = {name: x.index_select(0, indices) for name, x in inputs.items()}
        projection = project(inputs["means"], inputs["quaternions"], inputs["scales"], camera)
        if degree is None:
            return projection, inputs["colors"]
        directions = torch.nn.functional.normalize(inputs["means"] - camera.position, dim=-1)
        return projection, evaluate_sh(inputs["sh"], directions, degree)

    bin = staticmethod(bin_gaussians)

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Remove splats that are too faint from the lists."""
        return splats._replace(opacities=opacities, lists=splats.lists.only(opacities >= MIN_ALPHA))

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Draw splats front to back."""
        values = [splats.colors.T, splats.projection.depths[None]] if depth else [splats.colors.T]
        shape = (splats.lists.height, splats.lists.width)
        background = torch.nn.functional.pad(background, (0, len(values) - 1))[:, None, None].expand(-1, *shape)
        rows = torch.cat([geometry_rows(splats), *values])
        sums = walk(formulas.composite, rows, background, splats.lists, extra=1)
        return sums[:3], sums[-1], sums[3] if depth else None

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw one picture after the other."""
        drawn = (self.composite(self.masked(splats, row), background, depth=False) for row in opacities)
        images, alphas, _ = zip(*drawn, strict=True)
        return torch.stack(images), torch.stack(alphas)

    def absolute_gradients(self, splats: Splats, drawn: Tensor, gradient: Tensor) -> Tensor:
        """Differentiate block after block."""
        rows = pad_entries(torch.cat([geometry_rows(splats), splats.colors.T, splats.projection.depths[None]]))
        upstream, total, pixels = tile(gradient, splats.lists), rows.new_zeros(2, rows.shape[1]), pixel_offsets(rows)
        for block in blocks(splats.lists, rows.device):
            entries = rows[:, block.gaussians]
            raw = block.alphas(entries[:6]).requires_grad_()
            with torch.enable_grad():
                image = formulas.over(formulas.blend_weights(raw), entries[6:], rows.new_zeros(()))
            (to_raw,) = torch.autograd.grad(image, raw, upstream[block.tiles])
            # ln alpha = ln o - |(l11 dx + l21 dy, l22 dy)|^2 / 2, and the gradient of alpha is alpha times that of it.
            x, y, l11, l21, l22 = entries[:5, :, None]
            dx, dy = pixels[0] + block.centers[0][..., None] - x, pixels[1] + block.centers[1][..., None] - y
            w1, w2 = l11 * dx + l21 * dy, l22 * dy
            slopes = raw.detach() * to_raw * torch.stack([l11 * w1, l21 * w1 + l22 * w2])
            total.index_add_(1, block.gaussians.flatten(), slopes.abs().sum(2).flatten(1))
        return total[:, :-1].T

    def moments(self, splats: Splats, multiplier: Tensor, background: Tensor) -> MomentImages:
        """Composite mean and variance back to front."""
        one = torch.ones_like(splats.opacities)[None]
        return self._moments(splats, multiplier, background, one)

    def shares(self, splats: Splats, multiplier: Tensor, background: Tensor, weights: Tensor) -> Tensor:
        """Differentiate the variance with respect to factors on its summands."""
        with torch.enable_grad():
            factors = torch.ones_like(splats.opacities)[None].requires_grad_()
            variance = self._moments(splats, multiplier, background, factors).variance
            total = (variance.mean(0) * weights).sum()
        return torch.autograd.grad(total, factors)[0][0].double()

    def _moments(self, splats: Splats, multiplier: Tensor, background: Tensor, factors: Tensor) -> MomentImages:
        rows = torch.cat([geometry_rows(splats), multiplier.T, factors, splats.colors.T])
        images = walk(formulas.moments, rows, background, splats.lists, extra=4)
        return MomentImages(images[:3], images[3:6], images[6])
