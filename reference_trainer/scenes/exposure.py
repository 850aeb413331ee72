"""How much brighter a photograph is than the others, by channel: exposure and white balance."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from reference_trainer.camera import Camera
from reference_trainer.scenes.scene import View

__all__ = ["difference", "exposure_between", "exposures", "like_training", "with_one_exposure"]

_CELL = 8  # pixels: of points in one cell of a picture the nearest hide the others
_NEAR = 1.03  # points up to so many times as far as the nearest of their cell are seen
_INSIDE = 0.05, 0.95  # colors between which a photograph tells by how much it is brighter
_MIN_SHARED = 100  # points that two photographs must share
_COMMON = 0.9  # so many of these points must be brighter in the same photograph; shading and gloss change some


def with_one_exposure(
    train: Sequence[View], test: Sequence[View], positions: Tensor
) -> tuple[tuple[View, ...], tuple[View, ...], str]:
    """Divide photographs by how much brighter they are than the others, and return a note on it.

    For a test view, whose photograph must not be looked at, that is what the training cameras suggest, see
    `like_training`. Where the photographs do not differ, or were cut out and stand on a background of one color, the
    views are those that were given.
    """
    factors = exposures(train, positions)
    if factors is None:
        return tuple(train), tuple(test), ""
    note = f"{difference(factors)}: photographs are made equally bright"
    even = tuple(map(_divided, train, factors))
    return even, like_training(test, even), note


def like_training(views: Sequence[View], train: Sequence[View]) -> tuple[View, ...]:
    """Divide other photographs by the factor that the training views suggest for their cameras, if these have any."""
    factors = [view.exposure for view in train if view.exposure is not None]
    if not factors:
        return tuple(views)
    cameras = [view.camera for view in train]
    return tuple(_divided(view, exposure_between(view.camera, cameras, torch.stack(factors))) for view in views)


def _divided(view: View, factor: Tensor) -> View:
    return replace(view, image=view.image / factor[:, None, None], exposure=factor)


@torch.no_grad()
def exposures(views: Sequence[View], positions: Tensor) -> Tensor | None:
    """Return by how much each photograph is brighter than their geometric mean, by channel, (views, 3).

    From the colors of the points (M, 3) that two photographs share: the median of their ratio, for all pairs together
    by least squares. None unless in some pair nine of ten of these points are brighter in the same photograph: less is
    shading; and where photographs were cut out. A photograph that shares hardly any point has the factor 1.
    """
    if any(view.alpha is not None for view in views):
        return None
    seen = [_colors(view, positions) for view in views]
    rows, ratios, weights, common = [torch.ones(len(views))], [torch.zeros(3)], [0.0], False
    for (i, (a, in_a)), (j, (b, in_b)) in itertools.combinations(enumerate(seen), 2):
        both = in_a & in_b
        if int(both.sum()) < _MIN_SHARED:
            continue
        ratio = (b[both] / a[both]).log()
        brighter = (ratio > 0).float().mean(0)
        common |= bool((torch.maximum(brighter, 1 - brighter) > _COMMON).any())
        row = torch.zeros(len(views))
        row[i], row[j] = -1, 1
        rows.append(row)
        ratios.append(ratio.median(0).values)
        weights.append(float(both.sum()))
    if not common:
        return None
    weights[0] = 1 + sum(weights)  # the logarithms add up to 0
    scale = torch.tensor(weights).sqrt()[:, None]
    logarithms: Tensor = torch.linalg.lstsq(scale * torch.stack(rows), scale * torch.stack(ratios), driver="gelsd")[0]
    return logarithms.exp()


def difference(factors: Tensor) -> str:
    """Say by how much the brightest photograph is brighter than the darkest, in the channel where that is most."""
    largest = float((factors.amax(0) / factors.amin(0)).max())
    return f"exposures differ by up to {100 * (largest - 1):.0f} %"


def exposure_between(camera: Camera, cameras: Sequence[Camera], factors: Tensor) -> Tensor:
    """Return the factor (3,) for a camera from the two nearest: on the segment between them, as far as it is along."""
    positions = torch.stack([other.position for other in cameras])
    first, second = (positions - camera.position).norm(dim=1).topk(2, largest=False).indices.tolist()
    along = positions[second] - positions[first]
    share = float(((camera.position - positions[first]) @ along / along.square().sum().clamp_min(1e-12)).clamp(0, 1))
    found: Tensor = factors[first] ** (1 - share) * factors[second] ** share
    return found


def _colors(view: View, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the colors of the points in a photograph, (M, 3), and which it shows, neither dark nor burnt out."""
    camera, width, height = view.camera, view.camera.width, view.camera.height
    pixels, depths = camera.project(positions)
    inside = camera.inside(pixels, depths)
    x, y = pixels.unbind(1)
    columns = -(-width // _CELL)
    cells = torch.where(inside, (y / _CELL).long() * columns + (x / _CELL).long(), 0)
    far = torch.where(inside, depths, torch.inf)
    nearest = far.new_full((columns * -(-height // _CELL),), torch.inf).scatter_reduce(0, cells, far, "amin")
    # A mean over neighbors: a point that is half a pixel off would meet another color at every edge.
    smooth = avg_pool2d(view.image[None], 3, stride=1, padding=1, count_include_pad=False)
    grid = torch.stack([2 * x / width - 1, 2 * y / height - 1], 1)[None, None]
    colors = grid_sample(smooth, grid, padding_mode="border", align_corners=False)[0, :, 0].T
    low, high = _INSIDE
    shown = inside & (depths <= _NEAR * nearest[cells]) & (colors > low).all(1) & (colors < high).all(1)
    return colors, shown
