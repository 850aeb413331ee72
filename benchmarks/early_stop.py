"""How wrong a score is over lists that end where 1e-4 of the light is left, as contributing ids of gsplat and fvdb do.

``python -m benchmarks.early_stop RUN...``: runs of ``ca-reg train``; in float64, lists complete or cut, mean over the
test views.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from ca_reg import CAScore
from ca_reg.lists import ListMoments, PixelLists
from reference_trainer.camera import Camera
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render import splat
from reference_trainer.render.constants import MIN_TRANSMITTANCE, TILE
from reference_trainer.render.torch.compositing import geometry_rows, pixel_offsets
from reference_trainer.runs.measure import load_run_model

__all__ = ["complete_lists", "cut", "main"]


@torch.no_grad()
def complete_lists(model: TrainedModel, camera: Camera) -> PixelLists:
    """Return everything that the pixels of a view composite, in float64."""
    g = model.gaussians
    tensors = (x.detach().double() for x in (g.means, g.quaternions, g.scales, g.opacities))
    splats = splat(*tensors, camera, sh=g.sh.detach().double())
    lists, rows = splats.lists, geometry_rows(splats)
    tiles = torch.repeat_interleave(lists.lengths)
    x, y, l11, l21, l22, log_opacity = rows[:, lists.gaussians][..., None]
    offsets = pixel_offsets(rows)[..., 0] + TILE // 2
    px = offsets[0] + (tiles % lists.columns)[:, None] * TILE
    py = offsets[1] + (tiles // lists.columns)[:, None] * TILE
    w1, w2 = l11 * (px - x) + l21 * (py - y), l22 * (py - y)
    alphas = (log_opacity.exp2() * torch.exp(-0.5 * (w1 * w1 + w2 * w2))).clamp(max=0.99)
    entries, at = ((alphas >= 1 / 255) & (px < lists.width) & (py < lists.height)).nonzero().unbind(1)
    pixels = (py[entries, at] - 0.5).long() * lists.width + (px[entries, at] - 0.5).long()
    listed = lists.gaussians[entries].long()
    return PixelLists(listed, pixels, alphas[entries, at], splats.colors, lists.height, lists.width)


def cut(lists: PixelLists) -> PixelLists:
    """End every list before the entry that would leave less than `MIN_TRANSMITTANCE` of the light."""
    order = lists.pixels.argsort(stable=True)
    pixels, passed = lists.pixels[order], torch.log1p(-lists.alphas[order])
    total = passed.cumsum(0)
    first = torch.searchsorted(pixels, pixels)
    kept = order[total - (total - passed)[first] > torch.tensor(MIN_TRANSMITTANCE).log()]
    return lists._replace(gaussians=lists.gaussians[kept], pixels=lists.pixels[kept], alphas=lists.alphas[kept])


def exact(lists: PixelLists, drop_rate: float) -> float:
    """Return the exact score of lists."""
    n = torch.ones(len(lists.colors), dtype=torch.float64)
    return CAScore.exact(ListMoments(lambda opacity, view: lists), drop_rate=drop_rate)(n, None).value


def main(runs: list[str]) -> None:
    """Print the table."""
    print("| run | drop rate | exact CA, complete lists | cut | error | entries cut |\n|:--|---:|---:|---:|---:|---:|")
    for run in runs:
        model, scene = load_run_model(Path(run))
        views = [complete_lists(model, view.camera) for view in scene.test]
        shortened = [cut(x) for x in views]
        lost = 1 - sum(len(x.alphas) for x in shortened) / sum(len(x.alphas) for x in views)
        for rate in (0.1, 0.5, 0.6):
            a, b = (torch.tensor([exact(x, rate) for x in each]).nanmean().item() for each in (views, shortened))
            print(
                f"| {run} | {rate} | {1e3 * a:.4f}e-3 | {1e3 * b:.4f}e-3 | {b / a - 1:+.2%} | {lost:.1%} |", flush=True
            )


if __name__ == "__main__":
    main(sys.argv[1:])
