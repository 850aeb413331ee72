"""The tables of ``benchmarks/error_map.md``, made of the rows that ``python -m benchmarks.error_map --rows`` writes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ca_reg import error_maps as form_of
from reference_trainer.evaluation.style import readable
from reference_trainer.evaluation.tables import markdown_table

__all__ = ["scene_of", "setting_of", "tables"]

SETTINGS = {"recommended": "recommended", "dropout": "dropout alone", "plain": "plain", "binocular": "Binocular3DGS",
            "expectation": "expectation"}  # fmt: skip
PREDICTORS = {
    "error map": "**error map**", "weights as shipped": "weights as shipped",
    "ensemble of 3": "ensemble of three trainings", "ensemble of 5": "ensemble of five",
    "deviation": "deviation, training rate", "100 masks": "100 sampled masks", "5 masks": "5 sampled masks",
    "PH-Dropout's rate": "deviation, PH-Dropout's rate", "colors": "colors along the ray",
    "gradient": "gradient of the render", "1 - alpha": "1 - alpha", "random": "random",
    "Fisher": "diagonal Fisher information", "model alone": "model alone (no photographs)",
    "image, alpha and deviation": "image, alpha and deviation", "image and alpha": "image and alpha",
}  # fmt: skip
RIVALS = ("deviation", "100 masks", "5 masks", "PH-Dropout's rate", "colors", "gradient", "1 - alpha", "Fisher")


def tables(rows: Mapping[str, Any]) -> str:
    """Return the tables of the page, made of what ``--rows`` wrote."""
    models = {name: row for name, row in rows.items() if name not in ("pairs", "deciles")}
    kinds = [kind for kind in SETTINGS if kind in map(setting_of, models)]
    scenes = sorted({scene_of(name) for name in models}, key=lambda scene: (scene == "synthetic", scene))
    of = {(scene_of(name), setting_of(name)): row for name, row in models.items()}
    short = "{:.3f}".format
    means, parts = [], []
    for kind in kinds:
        own = [scene for scene in scenes if (scene, kind) in of]
        lines = []
        for key, label in PREDICTORS.items():
            found = {scene: of[scene, kind][key] for scene in own if key in of[scene, kind]}
            if found:
                mean = short(float(np.mean([*found.values()]))) if len(found) == len(own) else "-"
                cells = {readable(scene): short(found[scene]) if scene in found else "-" for scene in own}
                lines.append({f"{SETTINGS[kind]}, AUSE-MAE": label, **cells, "mean": mean})
        parts.append(markdown_table(lines, [*lines[0]]))
        best = [s for s in own if of[s, kind]["error map"] < min(of[s, kind].get(rival, math.inf) for rival in RIVALS)]
        means.append({"mean AUSE-MAE": SETTINGS[kind], "scenes": str(len(own))}
                     | {key: short(float(np.mean([of[s, kind][key] for s in own]))) for key in PREDICTORS
                        if key != "random" and all(key in row for row in models.values())}
                     | {"ahead of every rival": f"{len(best)} of {len(own)}"})  # fmt: skip
    psnr = [
        {"mean PSNR, dB: measured / expected": readable(scene)}
        | {
            SETTINGS[kind]: "{:.2f} / {:.2f}".format(*np.mean([v[2:] for v in of[scene, kind]["views"]], axis=0))
            if (scene, kind) in of
            else "-"
            for kind in kinds
        }
        for scene in scenes
    ]
    quality = []
    for kind in [*kinds, ""]:
        each = np.array([v for name, row in models.items() for v in row["views"] if kind in ("", setting_of(name))])
        ratio, shift = each[:, 1] / each[:, 0], each[:, 3] - each[:, 2]
        quality.append({
            "views": f"{SETTINGS.get(kind, 'all')}, {len(each)}",
            "mean error within 20 %": f"{np.mean((ratio > 0.8) & (ratio < 1.25)):.0%}",
            "within a factor of 1.5": f"{np.mean((ratio > 1 / 1.5) & (ratio < 1.5)):.0%}",
            "PSNR off by, dB": f"{shift.mean():+.2f}",
            "root mean square, dB": f"{np.sqrt((shift**2).mean()):.1f}",
            "in the interval of 80 %": f"{np.mean(np.abs(shift) < 1.2816 * form_of.FORMS[0].spread):.0%}",
        })  # fmt: skip
    order = []
    for first in kinds:
        for second in kinds[: kinds.index(first)]:
            found = rows["pairs"].get(f"{second} over {first}") or {
                who: (-m, -e) for who, (m, e) in rows["pairs"].get(f"{first} over {second}", {}).items()
            }
            if found:
                right = sum(m * e > 0 for m, e in found.values())
                measured, expected = np.mean([*found.values()], axis=0)
                order.append({"which is better?": f"{SETTINGS[second]} over {SETTINGS[first]}",
                              "scenes": str(len(found)), "measured, dB": f"{measured:+.2f}",
                              "expected, dB": f"{expected:+.2f}", "the sign is right in": str(right)})  # fmt: skip
    others = {
        "AUSE-RMSE": "AUSE-RMSE", "AUSE-RMSE, deviation": "of the deviation", "Spearman": "Spearman",
        "Spearman, deviation": "of the deviation ", "errors below 2.303 expected": "errors below 2.303 expected",
        "negative log likelihood": "negative log likelihood", "of the view's true mean": "of the view's true mean",
        **{f"without {term}": f"AUSE-MAE without {term.replace('*', ' ')}" for term in form_of.FORMS[0].weights},
    }  # fmt: skip
    more = [
        {"mean": SETTINGS[kind]}
        | {
            label: short(float(np.mean([row[key] for name, row in models.items() if setting_of(name) == kind])))
            for key, label in others.items()
        }
        for kind in kinds
    ]
    calibration = [
        {"deciles of the expectation": name} | {str(i): short(x) for i, x in enumerate(found, start=1)}
        for name, found in zip(("expected", "measured"), rows["deciles"], strict=True)
    ]
    summary = [markdown_table(each, [*each[0]]) for each in (means, psnr, order, quality, calibration, more) if each]
    return "\n".join([*summary, *parts])


def scene_of(name: str) -> str:
    """Return the scene of SCENE-SETTING-SEED."""
    return name.rsplit("-", 2)[0]


def setting_of(name: str) -> str:
    """Return the setting of SCENE-SETTING-SEED."""
    return name.rsplit("-", 2)[1]
