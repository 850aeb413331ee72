"""The engine of PyTorch operations, for any dtype and device; numba is tested against it."""

from __future__ import annotations

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.checks import numbers_to_check
from reference_trainer.render.constants import MIN_ALPHA, TILE
from reference_trainer.render.splats import MomentImages, Projected, Splats, TileLists
from reference_trainer.render.torch import compositing
from reference_trainer.render.torch.compositing import blocks, geometry_rows, pad_entries, pixel_offsets, tile, walk
from reference_trainer.render.torch.projection import evaluate_sh, project, visible

__all__ = ["TorchEngine", "bin_gaussians"]


def bin_gaussians(projected: Projected, width: int, height: int) -> TileLists:
    """List the Gaussians of every tile, see `Engine.bin`."""
    projection, opacities, device = projected.projection, projected.opacities, projected.opacities.device
    order = torch.argsort(projection.depths, stable=True)
    mean_x, mean_y = projection.means[order].unbind(-1)
    l11, l21, l22 = projection.factors[order].unbind(-1)
    xx, xy, yy = projection.covariances[order].unbind(-1)
    squared_radius = 2.0 * torch.log(opacities[order] / MIN_ALPHA).clamp_(min=0.0)

    # The rows of tiles that an ellipse meets: it spans sqrt(squared_radius yy) in y.
    reach = torch.sqrt(squared_radius * yy)
    top = torch.ceil(mean_y - reach - 0.5).clamp_(0, height)
    bottom = torch.floor(mean_y + reach - 0.5).clamp_(-1, height - 1)
    first_row = (top / TILE).long()
    rows = torch.where(bottom >= top, (bottom / TILE).floor().long() - first_row + 1, 0)
    entry, row = _expand(first_row, rows)

    # Then, within each row of tiles, the columns: from where the ellipse is furthest left to
    # furthest right, at its tips if these are in the row, else at the row's nearer border.
    y = mean_y[entry]
    upper = row * TILE + 0.5 - y
    lower = torch.clamp(row * TILE + (TILE - 0.5), max=height - 0.5) - y
    # The dy at which the ellipse reaches furthest right.
    tip = (xy * torch.sqrt(squared_radius / xx))[entry]
    limit, a, b, c, x = squared_radius[entry], l11[entry], l21[entry], l22[entry], mean_x[entry]

    def boundary(dy: Tensor, side: float) -> Tensor:
        # x at dy on the ellipse (a dx + b dy)^2 + (c dy)^2 = limit.
        half = torch.sqrt((limit - (c * dy) ** 2).clamp_(min=0.0))
        return x + (side * half - b * dy) / a

    left = boundary(torch.minimum(torch.maximum(-tip, upper), lower), -1.0)
    right = boundary(torch.minimum(torch.maximum(tip, upper), lower), 1.0)
    left = torch.ceil(left - 0.5).clamp_(0, width)
    right = torch.floor(right - 0.5).clamp_(-1, width - 1)
    first_column = (left / TILE).long()
    columns = torch.where(right >= left, (right / TILE).floor().long() - first_column + 1, 0)
    strip, column = _expand(first_column, columns)

    # Entries are in order of depth; a stable sort by tile keeps that order within every tile.
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tile = row[strip] * tiles_x + column
    gaussians = order[entry[strip]]
    tile, permutation = torch.sort(tile.int(), stable=True)
    touched = torch.zeros(order.shape[0], dtype=torch.bool, device=device)
    touched[gaussians] = True
    return TileLists(
        width=width,
        height=height,
        starts=torch.nn.functional.pad(torch.bincount(tile, minlength=tiles_x * tiles_y).cumsum(0), (1, 0)),
        gaussians=gaussians[permutation],
        touched=touched,
    )


def _expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """List the integers first[i] .. first[i] + counts[i] - 1; return the i and integer of each."""
    source = torch.repeat_interleave(counts)
    offset = first - (counts.cumsum(0) - counts)
    return source, offset[source] + torch.arange(source.shape[0], device=first.device)


class TorchEngine:
    """See `Engine`."""

    name = "torch"

    def project(
        self, inputs: dict[str, Tensor], camera: Camera, degree: int | None, background: Tensor | None = None
    ) -> Projected:
        """Project and color Gaussians."""
        depths, indices = visible(inputs, camera)
        seen = inputs if degree is None else inputs | {"sh": inputs["sh"][:, : (degree + 1) ** 2]}
        if indices.shape[0] < inputs["means"].shape[0]:
            seen = {name: x.index_select(0, indices) for name, x in seen.items()}
        projection = project(seen["means"], seen["quaternions"], seen["scales"], camera)
        if degree is None:
            colors = seen["colors"]
        else:
            directions = torch.nn.functional.normalize(seen["means"] - camera.position, dim=-1)
            colors = evaluate_sh(seen["sh"], directions, degree)
        numbers = numbers_to_check(depths, inputs["opacities"], projection, colors, camera, background)
        return Projected(indices, projection, seen["opacities"], colors, numbers)

    bin = staticmethod(bin_gaussians)

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Remove splats that are too faint from the lists."""
        return splats._replace(opacities=opacities, lists=splats.lists.only(opacities >= MIN_ALPHA))

    def composite(self, splats: Splats, background: Tensor, *, depth: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Render splats front to back."""
        values = [splats.colors.T, splats.projection.depths[None]] if depth else [splats.colors.T]
        shape = (splats.lists.height, splats.lists.width)
        background = torch.nn.functional.pad(background, (0, len(values) - 1))[:, None, None].expand(-1, *shape)
        rows = torch.cat([geometry_rows(splats), *values])
        sums = walk(compositing.composite, rows, background, splats.lists, extra=1)
        return sums[:3], sums[-1], sums[3] if depth else None

    def composite_masks(self, splats: Splats, opacities: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
        """Render one image after the other."""
        rendered = (self.composite(self.masked(splats, row), background, depth=False) for row in opacities)
        images, alphas, _ = zip(*rendered, strict=True)
        return torch.stack(images), torch.stack(alphas)

    def absolute_gradients(self, splats: Splats, rendered: Tensor, gradient: Tensor) -> Tensor:
        """Differentiate block after block."""
        rows = pad_entries(torch.cat([geometry_rows(splats), splats.colors.T, splats.projection.depths[None]]))
        upstream, total, pixels = tile(gradient, splats.lists), rows.new_zeros(2, rows.shape[1]), pixel_offsets(rows)
        for block in blocks(splats.lists, rows.device):
            entries = rows[:, block.gaussians]
            raw = block.alphas(entries[:6]).requires_grad_()
            with torch.enable_grad():
                image = compositing.over(compositing.blend_weights(raw), entries[6:], rows.new_zeros(()))
            (to_raw,) = torch.autograd.grad(image, raw, upstream[block.tiles])
            # ln alpha = ln o - |(l11 dx + l21 dy, l22 dy)|^2 / 2 with (dx, dy) from the mean to the
            # pixel: d ln alpha / dx_mean = l11 w1 and d ln alpha / dy_mean = l21 w1 + l22 w2. The
            # gradient of alpha is alpha times that of its logarithm. Absolute values before the sum
            # over pixels.
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
        with torch.inference_mode(False), torch.enable_grad():  # inference mode would record no gradient
            factors = torch.ones_like(splats.opacities)[None].requires_grad_()
            # Copies, as what was made in inference mode cannot be kept for a backward pass.
            variance = self._moments(splats, multiplier, background.clone(), factors).variance
            total = (variance.mean(0) * weights.clone()).sum()
            return torch.autograd.grad(total, factors)[0][0].double()

    def _moments(self, splats: Splats, multiplier: Tensor, background: Tensor, factors: Tensor) -> MomentImages:
        rows = torch.cat([geometry_rows(splats), multiplier.T, factors, splats.colors.T])
        images = walk(compositing.moments, rows, background, splats.lists, extra=4)
        return MomentImages(images[:3], images[3:6], images[6])
