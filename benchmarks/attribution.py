"""Which Gaussians of a run hold its co-adaptation, in numbers, pictures and a colored PLY.

python -m benchmarks.attribution RUN --split test --drop-rate 0.5
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from ca_reg import CAResult, Reason
from ca_reg.attribution import total_effects
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE, ca_picture
from reference_trainer.evaluation.pictures import file_names, save_png, side_by_side
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.shares import PER_WEIGHT_SCALE, Heat, colored_by, concentration
from reference_trainer.evaluation.tables import markdown_table
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import replacing, write_text
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import save_for_viewers
from reference_trainer.scenes.scene import View, Viewpoint

__all__ = ["main", "study_attribution"]

# Ends of the color scale of shares, in units of the mean. Shares grow with the size of a Gaussian, so a picture of
# them highlights the large ones; per blend weight they show what the CA map shows, Gaussian by Gaussian.
_SHARE_SCALE = (1.0, 100.0)

_README = """\
# Which Gaussians hold the co-adaptation

{table}
- `shares.npz`: `shares`, `total_effects` and `blend_weights`, one float64 per Gaussian in the order of the model
  (`numpy.load`).
- `attribution.ply`: the same Gaussians for any viewer, colored by their share: black {share[0]:.3g} (the mean share)
  or less, pale yellow {share[1]:.3g} (100 times the mean) or more.
- `attribution_per_weight.ply`: colored by their share per blend weight: black {share_per_weight[0]:.3g} (a tenth of
  the mean) or less, pale yellow {share_per_weight[1]:.3g} (10 times the mean) or more. The mean is the score over the
  sum of the weights. Here a Gaussian is bright that co-adapts much for what it contributes, small or large.
- `views/`: render; CA map (black 0, pale yellow {ca_range:g} or more, gray: not covered by the score); the render with
  the colors of either PLY.

Both scales are logarithmic, from black through purple, red and orange to pale yellow, and relative to the mean of this
model: they show where its co-adaptation lives. How much there is, the score tells.
"""


def study_attribution(
    run: Path,
    out: Path | None = None,
    *,
    split: str = "test",
    drop_rate: float = 0.5,
    device: str = "cpu",
) -> dict[str, Any]:
    """Attribute the exact score of a run; write the shares, colored PLYs, pictures and a table, and print the table.

    Args:
        run: folder of the run; its last checkpoint is measured.
        out: folder for the results; by default ``attribution`` in the run's folder.
        split: the views to use, ``"train"`` or ``"test"``.
        drop_rate: of the score.
        device: where to render.

    Returns:
        The content of ``attribution.json``.

    Raises:
        ValueError: if the split is unknown or empty, none of its views has a score, or all scores are 0.
        FileNotFoundError: if the folder holds no run.
    """
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', got {split!r}.")
    model, scene = load_run_model(run, device)
    out = run / "attribution" if out is None else out
    views = [view.to(device) for view in (scene.train if split == "train" else scene.test)]
    if not views:
        raise ValueError(f"the scene of {run} has no {split} view: give --split train.")
    heat = Heat.of(model, views, drop_rate=drop_rate)
    shares, weights, results = heat.shares, heat.weights, heat.results
    values = [result.value for result in results if result.reason is Reason.OK]
    score = model.exact_ca_score(drop_rate=drop_rate)
    found = [total_effects(score, model.gaussians.opacities, view).effects for view in views]  # 0 without a score
    effects = torch.stack(found).sum(0) / len(values)
    scales = {
        "share": [end * shares.mean().item() for end in _SHARE_SCALE],
        "share_per_weight": [end * heat.mean for end in PER_WEIGHT_SCALE],
    }
    data: dict[str, Any] = {
        "scene": scene.name,
        "split": split,
        "drop_rate": drop_rate,
        "gaussians": len(shares),
        "views": {view.name: result.value for view, result in zip(views, results, strict=True)},
        "score": sum(values) / len(values),
        "sum_of_shares": shares.sum().item(),
        "sum_of_total_effects": effects.sum().item(),
        "held_by": concentration(shares),
        "spearman": _correlations(model, views, shares, weights),
        "color_scales": scales,
        "machine": machine(),
    }
    a, b, c = (x.cpu().numpy() for x in (shares, effects, weights))
    with replacing(out / "shares.npz") as place, place.open("wb") as file:
        np.savez(file, shares=a, total_effects=b, blend_weights=c)
    colored = {
        "attribution": colored_by(model.gaussians, shares, *scales["share"]),
        "attribution_per_weight": colored_by(model.gaussians, heat.values, *scales["share_per_weight"]),
    }
    for name, gaussians in colored.items():  # with test-time opacities, as in a run's PLY for viewers
        save_for_viewers(
            dataclasses.replace(model.without_camera, gaussians=gaussians), out / f"{name}.ply", pad_to_degree=3
        )
    for name, view, result in zip(file_names(list(data["views"])), views, results, strict=True):
        save_png(out / "views" / f"{name}.png", _picture(model, colored.values(), view, result))
    write_json(out / "attribution.json", data)
    table = _table(data)
    write_text(out / "README.md", _README.format(table=table, ca_range=CA_PICTURE_RANGE, **scales))
    print(table)
    print(f"Shares, PLYs and pictures are in {out}; README.md there says what the colors mean")
    return data


def _correlations(
    model: TrainedModel, views: Sequence[Viewpoint], shares: Tensor, weights: Tensor
) -> dict[str, float | None]:
    """Return Spearman's rank correlation of the share with other properties; None where all values are equal."""
    from scipy.stats import spearmanr  # a second to import

    gaussians = model.gaussians
    depth = torch.stack([view.camera.project(gaussians.means)[1] for view in views]).mean(0)
    known = {"opacity": gaussians.opacities, "largest scale": gaussians.scales.amax(1), "mean depth": depth}
    known["blend weight"] = weights
    pairs = {name: (shares.cpu(), values.detach().cpu()) for name, values in known.items()}
    ordered = {name: all(bool(x.min() < x.max()) for x in pair) for name, pair in pairs.items()}
    return {name: float(spearmanr(*pair).statistic) if ordered[name] else None for name, pair in pairs.items()}


@torch.no_grad()
def _picture(model: TrainedModel, colored: Iterable[Gaussians], view: View, result: CAResult) -> Tensor:
    """Arrange the render, the CA map and the renders in other colors side by side."""
    models = [model, *(dataclasses.replace(model, gaussians=gaussians) for gaussians in colored)]
    plain, *others = [each.test_rendering(view).image for each in models]
    texts = [f"{low:g} to {high:g} x mean" for low, high in (_SHARE_SCALE, PER_WEIGHT_SCALE)]
    labels = ["render", f"exact CA {result.value * 1e3:.2f}e-3", f"share, {texts[0]}", f"share per weight, {texts[1]}"]
    return side_by_side([plain, ca_picture(result), *others], labels)


def _table(data: dict[str, Any]) -> str:
    """Return the numbers in Markdown."""
    part, count = data["held_by"]["half"], data["gaussians"]
    held = {name: value for name, value in data["held_by"].items() if name != "half"}
    rows: dict[str, object] = {
        f"score x1e-3, mean over {data['split']} views": f"{data['score'] * 1e3:.7g}",
        "sum of the shares x1e-3": f"{data['sum_of_shares'] * 1e3:.7g}",
        "sum of the total effects / score": data["sum_of_total_effects"] / data["score"],
        **{f"score held by the {name} of the Gaussians": f"{value:.1%}" for name, value in held.items()},
        "Gaussians that hold half of the score": f"{round(part * count)} of {count} ({part:.2%})",
        **{f"rank correlation of share and {name}": value for name, value in data["spearman"].items()},
    }
    return markdown_table([{"quantity": name, "value": value} for name, value in rows.items()], ["quantity", "value"])


def main(
    run: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    split: Literal["test", "train"] = "test",
    drop_rate: float = 0.5,
    device: str = "cpu",
) -> None:
    """Attribute the exact score of a run to its Gaussians.

    Args:
        run: folder of a run.
        out: folder for the results; by default <run>/attribution.
        split: which views.
        drop_rate: drop rate of the score.
        device: "cpu" or "cuda".
    """
    study_attribution(run, out, split=split, drop_rate=drop_rate, device=device)


if __name__ == "__main__":
    tyro.cli(main)
