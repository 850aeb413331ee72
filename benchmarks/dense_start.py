"""How good the points of a dense start are: depths, coverage, number and time, against other clouds of real scenes.

    python -m benchmarks.dense_start ../shared/data

writes ``benchmarks/data/dense_start.json`` and prints the table of ``benchmarks/dense_start.md``.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.colmap import read_colmap
from reference_trainer.scenes.dense import dense_points
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.points import colmap_points
from reference_trainer.scenes.scene import View

SCENES: tuple[tuple[str, dict[str, str], str], ...] = (
    ("fern", {"images": "images_8"}, "sparse_3views"),
    ("fern", {"images": "images_16"}, "sparse_3views"),
    ("dtu-scan65", {}, "sparse_3views"),
    ("dtu-scan24", {}, "sparse_3views"),
    ("sceaux", {}, "sparse_3views"),
    ("cape", {}, "sparse_3views"),
    ("fountain", {"split": "split_near"}, "sparse_3near"),
    ("herz-jesu", {"split": "split_near"}, "sparse_3near"),
)
"""Folder, options, and the SIFT points of the training views, which tell the range of depth."""
CELL = 8  # pixels


def visible(points: Tensor, camera: Camera, radius: float) -> tuple[Any, Any]:
    """Return pixels and depths of the points that no other one within a radius in the picture hides by 5 %."""
    pixels, depths = camera.project(points.double())
    inside = camera.inside(pixels, depths)
    places, far = pixels[inside].numpy(), depths[inside].numpy()
    nearest = np.array([far[around].min() for around in cKDTree(places).query_ball_point(places, radius)])
    return places[far <= 1.05 * nearest], far[far <= 1.05 * nearest]


def truth(folder: Path, view: View) -> tuple[Any, Any]:
    """Return pixels and depths of a reconstruction's points in a view: those it observed there, if it says so."""
    model = read_colmap(folder)
    number = {image.name: image.id for image in model.images}.get(view.name)
    positions = torch.from_numpy(model.points.positions)
    tracked = [number in track for track in model.points.tracks]
    if any(tracked):
        pixels, depths = view.camera.project(positions[torch.tensor(tracked)])
        return pixels.numpy(), depths.numpy()
    return visible(positions, view.camera, radius=view.camera.width / 84)


def judged(points: Tensor, views: tuple[View, ...], folder: Path) -> dict[str, float]:
    """Compare a cloud with the points of a reconstruction, by nearest pixel, at most one pixel away."""
    errors, cells, known = [], [], 0
    for view in views:
        places, depths = visible(points, view.camera, radius=2.0)
        at, true = truth(folder, view)
        distance, nearest = cKDTree(places).query(at)
        errors.append(np.abs(depths[nearest] / true - 1)[distance <= 1])
        known += len(true)
        taken = len(np.unique((places // CELL).astype(int), axis=0))
        cells.append(taken / (-(-view.camera.width // CELL) * -(-view.camera.height // CELL)))
    error = np.concatenate(errors)
    shares = {f"off by {limit:.0%}": float((error > limit).mean()) for limit in (0.02, 0.1)}
    return {"points": len(points), "covered": float(np.mean(cells)), "compared": len(error) / known, **shares}


def measured(root: Path, name: str, options: dict[str, str], sift: str) -> list[dict[str, Any]]:
    """Measure all clouds of a scene."""
    views = load_scene(SceneOptions(str(root / name), **options)).train
    guide = colmap_points(root / name / sift / "0")
    assert guide is not None
    begun = time.thread_time()
    cloud = dense_points(views, guide)
    seconds = time.thread_time() - begun
    clouds = {"dense start": cloud.positions, "SIFT": guide.positions}
    assert cloud.confidence is not None
    clouds["its confident half"] = cloud.positions[cloud.confidence >= cloud.confidence.median()]
    folder = root / name / "sparse_3views_dense/0"
    if folder.is_dir():
        clouds["other dense cloud"] = colmap_points(folder).positions  # type: ignore[union-attr]
    against = folder if name.startswith("dtu") else root / name / "sparse/0"  # DTU has no points of all views
    label = f"{name} {views[0].camera.width}x{views[0].camera.height}"
    rows = []
    for kind, points in clouds.items():
        if name.startswith("dtu") and kind in ("SIFT", "other dense cloud"):
            continue
        row = {"scene": label, "cloud": kind, **judged(points, views, against)}
        rows.append(row | ({"seconds": seconds} if kind == "dense start" else {}))
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| scene | cloud | points | cells covered | off by 2 % | off by 10 % | compared | s |"]
    lines.append("|:---|:---|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        shares = " | ".join(f"{100 * row[key]:.1f} %" for key in ("off by 2%", "off by 10%", "compared"))
        seconds = f"{row['seconds']:.1f}" if "seconds" in row else ""
        cells = f"{row['points']:,} | {100 * row['covered']:.0f} % | {shares} | {seconds}"
        lines.append(f"| {row['scene']} | {row['cloud']} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    torch.set_num_threads(1)
    dense_points(synthetic_scene(80, 60).train, count=100)  # compiles the loops
    rows = [row for case in SCENES for row in measured(Path(sys.argv[1]), *case)]
    machine = {"python": platform.python_version(), "torch": torch.__version__, "numba": numba.__version__}
    out = Path(__file__).parent / "data/dense_start.json"
    out.parent.mkdir(exist_ok=True)
    short = [{key: round(x, 4) if isinstance(x, float) else x for key, x in row.items()} for row in rows]
    out.write_text(json.dumps({"machine": machine, "rows": short}, indent=1) + "\n")
    print(table(rows))
