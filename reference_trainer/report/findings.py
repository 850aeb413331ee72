"""What a report shows of one run: its pictures, and how much every Gaussian co-adapts relative to its contribution."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ca_reg import CAResult, Reason
from reference_trainer.evaluation.evaluate import ca_picture, error_picture
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.shares import Heat, concentration
from reference_trainer.evaluation.tables import EXACT
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.report.packing import jpeg, numbers
from reference_trainer.rotations import rotation_matrices
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.load import evenly_spaced
from reference_trainer.scenes.scene import Scene, View, Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views

__all__ = ["Findings", "find"]


@dataclass(frozen=True)
class Findings:
    """What a report knows about a run.

    Args:
        label: what the page calls it.
        model: at its last checkpoint.
        opacities: that the page draws it with, (N,).
        scene: what it was trained on.
        views: that it is shown from, by split, those that were not trained on first if they have photographs.
        pictures: per view, ``"render"`` and where they exist ``"error"`` and ``"co-adaptation"``, and a ``"caption"``.
        heat: of the exact score over these views; None if there is no score to attribute.
        notes: what is missing, and why.
    """

    label: str
    model: TrainedModel
    opacities: Tensor
    scene: Scene
    views: Mapping[str, Sequence[Viewpoint]]
    pictures: list[dict[str, str]]
    heat: Heat | None
    notes: list[str]

    def packed(self, low: float, high: float) -> dict[str, Any]:
        """Return the model as the page draws it, with arrays as little-endian numbers in base64.

        ``geometry`` holds 16 float32 per Gaussian: position (3), opacity, covariance (xx, xy, xz, yy, yz, zz), rank by
        share per weight in [0, 1), 0, color of the heat (3), 0. ``colors`` holds the spherical harmonics coefficients,
        (N, (degree + 1)^2, 3) in float16. ``held`` is the fraction of the score held by the 0, 1, ... 100 % of the
        Gaussians of highest rank.

        Args:
            low: share per weight of the darkest color.
            high: share per weight of the brightest color.
        """
        gaussians, n = self.model.gaussians, len(self.model.gaussians)
        axes = rotation_matrices(gaussians.quaternions) * gaussians.scales[:, None]
        covariances = (axes @ axes.transpose(1, 2)).flatten(1)[:, [0, 1, 2, 4, 5, 8]]
        rank, heat, held = torch.zeros(n), torch.full((n, 3), 0.5), []
        if self.heat is not None:
            rank, heat = self.heat.ranks.cpu(), heat_colors(self.heat.values, low, high)
            along = self.heat.shares[self.heat.ranks.argsort(descending=True)].cumsum(0)
            along = torch.cat([along.new_zeros(1), along / along[-1]])
            held = [round(along[percent * n // 100].item(), 4) for percent in range(101)]
        columns = [gaussians.means, self.opacities[:, None], covariances, rank[:, None], torch.zeros(n, 1)]
        columns += [heat, torch.zeros(n, 1)]
        degree = gaussians.sh_degree if self.model.sh_degree is None else self.model.sh_degree
        return {
            "label": self.label,
            "background": self.model.background.tolist(),
            "count": n,
            "degree": degree,
            "geometry": numbers(torch.cat([column.float().cpu() for column in columns], 1), "<f4"),
            "colors": numbers(gaussians.sh[:, : (degree + 1) ** 2], "<f2"),
            "held": held,
        }

    def attribution(self) -> dict[str, object]:
        """Return the row of the table on how concentrated the score is; empty without heat."""
        if self.heat is None:
            return {}
        held = concentration(self.heat.shares)
        half = held.pop("half")
        found = {f"held by the {name}": f"{part:.1%}" for name, part in held.items()}
        score = f"{self.heat.shares.sum().item() * 1e3:.2f}"
        return {"run": self.label, EXACT: score, **found, "half is held by": f"{half:.2%}"}


@torch.no_grad()
def find(run: Path, label: str, *, views: int, device: str = "cpu", trust: Collection[str] = ()) -> Findings:
    """Draw a run's last checkpoint from its views, and attribute the exact score at drop rate 1/2 to its Gaussians.

    Args:
        run: its folder.
        label: what the page calls it.
        views: how many of each split, evenly spaced.
        device: where to render.
        trust: as for `load_run`.

    Raises:
        FileNotFoundError: if the folder holds no run.
    """
    model, scene = load_run_model(run, device, trust=trust)
    notes: list[str] = []
    if model.depends_on_camera:
        notes.append(f"{label}: its test-time opacities depend on the camera; the model is drawn with the plain ones.")
    last = "train" if scene.test else ""  # what can be compared with a photograph comes first
    found = sorted(measured_views(scene).items(), key=lambda item: (item[0] == last, item[0] != "train"))
    chosen = {split: [of[i].to(device) for i in evenly_spaced(len(of), min(views, len(of)))] for split, of in found}
    flat = [view for of in chosen.values() for view in of]
    heat = None
    try:
        heat = Heat.of(model, flat)
    except ValueError as error:
        notes.append(f"{label}: no co-adaptation: {error}")
    results = [None] * len(flat) if heat is None else heat.results
    pictures = [_pictures(model, view, result) for view, result in zip(flat, results, strict=True)]
    return Findings(label, model, model.without_camera.test_opacities, scene, chosen, pictures, heat, notes)


def _pictures(model: TrainedModel, view: Viewpoint, result: CAResult | None) -> dict[str, str]:
    """Return the pictures of a view and their caption."""
    image = model.test_rendering(view).image.clamp(0, 1)
    found, said = {"render": jpeg(image)}, []
    if isinstance(view, View):
        found["error"] = jpeg(error_picture(image, view.image))
        said.append(f"PSNR {psnr(image, view.image, view.mask):.2f} dB")
    if result is not None and result.reason is Reason.OK:
        found["co-adaptation"] = jpeg(ca_picture(result))
        said.append(f"exact CA {result.value * 1e3:.2f}e-3")
    return found | {"caption": ", ".join(said)}
