"""Is a finished model cleaned better by its expected errors than by its co-adaptation, at equal count?

    python -m benchmarks.clean_by_error SCENE-SETTING-SEED=RUN ... --rows FILE [--fractions 0.02 0.1] [--steps 100]

What ``ca-reg clean`` does, with other numbers in place of the shares of the score. RUN is the folder of a finished
training. Prints the PSNR of the test views, and keeps it in the file; what is there is not measured again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.error_map import scene_of, setting_of
from ca_reg.error_maps import expected_error
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.shares import Heat, all_but_highest, blend_weights
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render.renderer import rasterize
from reference_trainer.runs.edit_ply import refined
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import unseen_views


def error_shares(model: TrainedModel, errors: Sequence[tuple[Viewpoint, Tensor]]) -> Tensor:
    """Return the errors of pixels, (H, W) a view, handed to the Gaussians by their weight in the render, (N,)."""
    opacities = model.test_opacities
    total = torch.zeros_like(opacities, dtype=torch.float64)
    for view, error in errors:
        splats = model.splats(opacities, view)
        colors = torch.zeros_like(splats.colors).requires_grad_()  # the image is linear in the colors
        red = (rasterize(splats._replace(colors=colors)).image[0] * error).sum()
        total[splats.indices] += torch.autograd.grad(red, colors)[0][:, 0]
    return total


def orders(model: TrainedModel, scene: Scene) -> dict[str, Tensor]:
    """Return a number per Gaussian for every criterion, (N,): the highest go first, those of 0 stay."""
    maps, unseen = ErrorMaps(model, scene.train), unseen_views(scene)
    elsewhere = [(view, maps(view).error) for view in unseen]
    # A training view as if its photograph had not been taken.
    here = [(view, expected_error(maps.left_out(i)[1], unit=maps.unit).error) for i, view in enumerate(scene.train)]
    random = torch.Generator().manual_seed(0)
    found = {
        "co-adaptation per weight": Heat.of(model, scene.train).values,
        "expected error": error_shares(model, elsewhere),
        "expected error per weight": error_shares(model, elsewhere) / blend_weights(model, unseen),
        "the same, training views": error_shares(model, here) / blend_weights(model, scene.train),
        "random": torch.rand(len(model.gaussians), generator=random) + 1e-6,
    }
    return {name: values.nan_to_num(0.0) for name, values in found.items()}


def quality(model: TrainedModel, scene: Scene) -> float:
    """Return the mean PSNR of the test views."""
    with torch.no_grad():
        images = [model.test_rendering(view).image.clamp(0, 1) for view in scene.test]
    return float(np.mean([psnr(image, view.image, view.mask) for image, view in zip(images, scene.test, strict=True)]))


def compared(run: Path, fractions: Sequence[float], steps: int) -> dict[str, tuple[float, float, int]]:
    """Return test PSNR without some Gaussians, and after further training, and how many went, by what was done."""
    model, scene = load_run_model(run)
    found = {"nothing": (quality(model, scene), quality(refined(model, scene, steps), scene), 0)}
    for criterion, values in orders(model, scene).items():
        for fraction in fractions:
            stays = all_but_highest(values, fraction)
            less = replace(model, gaussians=model.gaussians[stays])
            after = quality(refined(less, scene, steps), scene)
            found[f"{criterion}, {fraction:g}"] = quality(less, scene), after, int((~stays).sum())
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="*")
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--fractions", type=float, nargs="+", default=[0.02, 0.1])
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = json.loads(options.rows.read_text()) if options.rows.exists() else {}
    for name, run in (each.split("=", 1) for each in options.runs):
        if name not in rows:
            found = compared(Path(run), options.fractions, options.steps)
            rows[name] = {what: [*(round(x, 3) for x in values)] for what, values in found.items()}
            lines = ",\n".join(f"{json.dumps(n)}: {json.dumps(rows[n])}" for n in sorted(rows))
            options.rows.write_text(f"{{\n{lines}\n}}\n")
            print("measured", name, rows[name], flush=True)
    kinds = [*dict.fromkeys(setting_of(name) for name in rows)]
    print("\n| dB over nothing removed, after the steps | " + " | ".join([*rows, *kinds]) + " |")
    print("|:---" + "|---:" * (len(rows) + len(kinds)) + "|")
    for what in next(iter(rows.values())):
        gains = {name: row[what][1] - row["nothing"][1] for name, row in rows.items()}
        means = [np.mean([gain for name, gain in gains.items() if setting_of(name) == kind]) for kind in kinds]
        print(f"| {what} | " + " | ".join(f"{x:+.2f}" for x in [*gains.values(), *means]) + " |")
    print(f"{len(rows)} models of {len(set(map(scene_of, rows)))} scenes")


if __name__ == "__main__":
    main()
