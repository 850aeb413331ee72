"""What a report shows of one run: its pictures, what is expected where nobody was, and how every Gaussian co-adapts."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import avg_pool2d, normalize

from ca_reg import CAResult, Reason
from ca_reg.error_maps import ErrorMap
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import ca_picture, error_picture, expected_error_picture
from reference_trainer.evaluation.metrics import view_psnr
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.shares import Heat, concentration, guard
from reference_trainer.evaluation.tables import EXACT
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.report.packing import heat_uri, image_uri, quantized
from reference_trainer.runs.folder import GUARD_PICTURE
from reference_trainer.runs.guarded import hanging_picture, removed_from
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.images import read_image
from reference_trainer.scenes.load import evenly_spaced
from reference_trainer.scenes.scene import Scene, View, Viewpoint
from reference_trainer.scenes.virtual_cameras import measured_views, unseen_views

__all__ = ["Findings", "find", "pictures_of"]

MOST_UNSEEN = 27
"""Cameras without a photograph, at most, among which the worst are found: all of those between and beyond three."""


@dataclass(frozen=True)
class Findings:
    """What a report knows about a run.

    Args:
        label: what the page calls it.
        model: at its last checkpoint.
        scene: what it was trained on.
        views: that it is shown from, by split, those that were not trained on first if they have photographs.
        pictures: per view, ``"render"`` and where they exist ``"error"``, ``"expected error"`` and ``"co-adaptation"``,
            and a ``"caption"``.
        heat: of the exact score over these views; None if there is no score to attribute.
        notes: what is missing, and why.
        unseen: cameras that nobody took, with what is expected there.
        hangs: a line about what hangs there, None if nothing does or the model cannot be guarded.
        removed: a line for each time that the guard removed what hung while the model trained.
        veils: pictures, as data URIs by what they show, of the worst place with and without what hung or hangs.
    """

    label: str
    model: TrainedModel
    scene: Scene
    views: Mapping[str, Sequence[Viewpoint]]
    pictures: list[dict[str, str]]
    heat: Heat | None
    notes: list[str]
    unseen: Sequence[tuple[Viewpoint, ErrorMap]]
    hangs: str | None
    removed: Sequence[str]
    veils: Mapping[str, str]

    def packed(self, low: float, high: float) -> dict[str, Any]:
        """Return the model as the page renders it: its Gaussians in the order of their heat, those of least heat first.

        ``values`` are `quantized` columns: the position (3) less ``center``, in units of ``scale`` and as
        sign(x) log(1 + |x|), the logarithm of the scales (3), the quaternion (4, wxyz), opacity, color of the heat (3),
        and the coefficients of the spherical harmonics, ((degree + 1)^2, 3). ``held`` is the fraction of the score held
        by the 0, 1, ... 100 % of the Gaussians of most heat. ``low`` and ``high`` are the shares per weight of the
        darkest and the brightest color.
        """
        order, n = torch.arange(len(self.model.gaussians)), len(self.model.gaussians)
        heat, held = torch.full((n, 3), 0.5), list[float]()
        if self.heat is not None:
            order = self.heat.ranks.cpu().argsort()
            heat = heat_colors(self.heat.values, low, high)[order]
            along = self.heat.shares.cpu()[order.flip(0)].cumsum(0)
            along = torch.cat([along.new_zeros(1), along / along[-1]])
            held = [round(along[percent * n // 100].item(), 4) for percent in range(101)]
        gaussians = self.model.gaussians.map(lambda x: x.detach().cpu()[order])
        degree = gaussians.sh_degree if self.model.sh_degree is None else self.model.sh_degree
        center = gaussians.means.median(0).values
        means = gaussians.means - center
        scale = means.norm(dim=1).median().clamp_min(1e-9)
        columns = [
            # Relative to the distance from the middle: most Gaussians are close to it, a few very far away.
            (means.sign() * (means / scale).abs().log1p(), 2e-4),
            (gaussians.log_scales, 0.02),
            (normalize(gaussians.quaternions, dim=1), 1 / 256),
            (self.model.without_camera.test_opacities.cpu()[order][:, None], 1 / 512),
            (heat, 1 / 255),
            (gaussians.sh[:, 0], 1 / 128),  # a quarter of a gray level
            (gaussians.sh[:, 1 : (degree + 1) ** 2].flatten(1), 1 / 36),  # an error of 2 gray levels
        ]
        return {
            "label": self.label,
            "background": self.model.background.tolist(),
            "count": n,
            "degree": degree,
            "center": center.tolist(),
            "scale": scale.item(),
            "values": quantized(columns),
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
    """Render a run's last checkpoint from its views, and attribute the exact score at drop rate 1/2 to its Gaussians.

    The expected error follows from the model and the training photographs, so these have none themselves. Of each split
    so many ``views`` are shown, evenly spaced; ``trust``, and errors, are as for `load_run`.
    """
    model, scene = load_run_model(run, device, trust=trust)
    notes: list[str] = []
    if model.depends_on_camera:
        notes.append(f"{label}: its test-time opacities depend on the camera; it is rendered with the plain ones.")
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
    errors = ErrorMaps(model, scene.train)
    pictures = []
    for view, result in zip(flat, results, strict=True):
        own = any(view is each for each in chosen["train"])
        expected = None if own else errors(view, view.mask if isinstance(view, View) else None)
        pictures.append(pictures_of(model, view, expected, result))
    unseen, hangs, removed, veils = [], None, removed_from(run), dict[str, str]()
    if removed and (shown := run / GUARD_PICTURE).exists():
        veils["what the guard removed"] = image_uri(read_image(shown)[0])
    if len(scene.train) > 1:
        places = unseen_views(scene)
        places = [places[i].to(device) for i in evenly_spaced(len(places), min(MOST_UNSEEN, len(places)))]
        unseen = [(place, errors(place)) for place in places]
        if len(model.chain) and (still := guard(model, scene)).where:  # at all places, as `ca-reg evaluate` looks
            hangs, veils["what hangs there"] = str(still), image_uri(hanging_picture(model, scene, still))
    else:
        notes.append(f"{label}: no views that you did not take, because none lies between or beyond a single camera.")
    return Findings(label, model, scene, chosen, pictures, heat, notes, unseen, hangs, removed, veils)


@torch.no_grad()
def pictures_of(
    model: TrainedModel, view: Viewpoint, expected: ErrorMap | None, result: CAResult | None = None
) -> dict[str, str]:
    """Return the pictures of a view as data URIs, and their caption."""
    render = model.test_rendering(view).image
    image = render.clamp(0, 1)
    found, said = {"render": image_uri(image)}, []
    if isinstance(view, View):
        found["error"] = heat_uri(error_picture(image, view.image))
        if not math.isnan(measured := view_psnr(render, view)):  # its mask may leave no pixel
            said.append(f"PSNR {measured:.2f} dB")
    if expected is not None:
        half = avg_pool2d(expected.error[None], 2, ceil_mode=True)[0]  # it is smooth, and a third of the size
        found["expected error"] = heat_uri(expected_error_picture(expected._replace(error=half)))
        low, high = expected.interval
        if not math.isnan(expected.psnr):
            said.append(f"expected {'' if said else 'PSNR '}{expected.psnr:.1f} dB ({low:.1f} to {high:.1f})")
    if result is not None and result.reason is Reason.OK:
        found["co-adaptation"] = heat_uri(ca_picture(result))
        said.append(f"exact CA {result.value * 1e3:.2f}e-3")
    return found | {"caption": ", ".join(said)}
