"""A recipe beside the unmodified fork it is named after: the same views, points and schedule, scored by one evaluator.

``PYTHONPATH=tests python -m benchmarks.beside fsgs path/to/FSGS --path data/fern`` trains both, the fork by the
launcher on a CPU, and puts the figures into ``beside.json``, rows as of `ca-reg study paper`. What a fork imports must
be installed. A second start takes what is finished.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image
from scipy.interpolate import NearestNDInterpolator
from scipy.spatial.transform import Rotation

from reference_trainer.cli import main as ca_reg
from reference_trainer.evaluation.results import machine
from reference_trainer.json_files import read_json
from reference_trainer.scenes.depth import point_prior
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.pseudo import depth_bounds
from reference_trainer.scenes.scene import Scene
from reference_trainer.studies.paper.rows import Row, Rows

_NEVER = 10**6
_ROOT = Path(__file__).parents[2]  # before the tests in the path: their folders have names of packages


@dataclass(frozen=True)
class Fork:
    """What trains a fork, and what brings the recipe to the same schedule, at ``{n}`` iterations.

    Args:
        script: with its options, after those that all have.
        recipe: options of `ca-reg train`, after those that all have.
    """

    script: str
    recipe: str


_ALL = Fork(
    f"-r 1 --images images --iterations {{n}} --position_lr_max_steps {{n}} --save_iterations {{n}} "
    f"--test_iterations {_NEVER} --port 0 --densify_from_iter {{third}} --densification_interval {{sixth}}",
    "--iterations {n} --densify-from {third} --densify-every {sixth} --no-auto --monitor-every 0",
)
_FSGS = "--n_views 3 --densify_until_iter {n} --densify_grad_threshold 0.0005 --prune_from_iter {third}"
_INRIA = (
    "--densify_until_iter {until} --opacity_reset_interval {reset}",
    (
        "--densify-until {until} --opacity-reset-from {reset} --opacity-reset-every {reset} "
        "--prune-size-from {reset} --sh-every 1000"
    ),
)
FORKS = {
    "inria": Fork(f"train.py {_INRIA[0]}", _INRIA[1]),
    "absgs": Fork(
        f"train.py {_INRIA[0]} --opacity_reduce_interval {{quarter}}",
        f"{_INRIA[1]} --density absgrad(ceiling_every={{quarter}})",
    ),
    "mvgs": Fork(f"train.py {_INRIA[0]} --mv 3", _INRIA[1]),
    "binocular": Fork(
        "train.py --shift_cam_start {half}", "--sh-every 1000 --loss photometric+warp(between(1.0,{half}))"
    ),
    "3dgs": Fork(
        f"train.py {_FSGS} --gaussiansN 1 --onlyrgb --start_sample_pseudo {{half}}",
        "--sh-every 500 --opacity-reset-from {half_1}",
    ),
    "corgs": Fork(
        f"train.py {_FSGS} --gaussiansN 2 --coreg --coprune --random_background --start_sample_pseudo {{quarter}}",
        "--sh-every 500 --opacity-reset-from {quarter_1} --loss photometric+co_regularization(between(1.0,{quarter}))",
    ),
    "fsgs": Fork(
        f"train.py {_FSGS} --start_sample_pseudo {{half}} --end_sample_pseudo {{late}}"
        f" --sample_pseudo_interval {_NEVER}",
        "--sh-every 500 --opacity-reset-from {half_1} --density proximity(until={n}) --depth {scene}/depth:inverse"
        " --loss photometric+pearson(between(0.05,0,{late}))+pearson(between(0.001,{late}))",
    ),
}
"""By the name of the recipe."""

_CHILD = """
import itertools, os, random, runpy, sys, time
import numpy, torch
from PIL import Image
from torch.optim.optimizer import register_optimizer_step_post_hook

seed, scene, steps = int(os.environ["BESIDE_SEED"]), os.environ["BESIDE_SCENE"], []
def raised(module, name):
    fixed = getattr(module, name)
    setattr(module, name, lambda value: fixed(value + seed))
for module, name in (random, "seed"), (numpy.random, "seed"), (torch, "manual_seed"):
    raised(module, name)

class Depths(torch.nn.Module):  # for a network that FSGS downloads: the files, in the order of the photographs
    dpt_transform = None
    def __init__(self):
        super().__init__()
        files = sorted(os.listdir(f"{scene}/depth"))
        self.next = itertools.cycle([numpy.array(Image.open(f"{scene}/depth/{file}")) for file in files])
    def forward(self, image):
        return torch.from_numpy(next(self.next)).float()[None]

torch.hub.load = lambda *args, **kwargs: Depths()
register_optimizer_step_post_hook(lambda *args: steps.append(time.process_time()))
try:
    runpy.run_module("ca_reg.integrations.run", run_name="__main__", alter_sys=True)
finally:
    open(os.environ["BESIDE_SECONDS"], "w").write(str(steps[-1] - steps[0]))
"""


def write_scene(scene: Scene, folder: Path) -> None:
    """Write the training views and initial points for the forks: COLMAP text, PLY, LLFF bounds, depth as PNG."""
    assert scene.points is not None
    sparse = folder / "sparse/0"
    for each in (sparse, folder / "images", folder / "depth", folder / "depth_maps", folder / "3_views/dense"):
        each.mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for number, view in enumerate(sorted(scene.train, key=lambda view: view.name), start=1):
        camera, stem = view.camera, Path(view.name).stem
        cameras.append(
            f"{number} PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}\n"
        )
        pose = camera.world_to_camera.double().numpy()
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        images.append(" ".join(map(str, [number, *turn, *pose[:3, 3], number, f"{stem}.png"])) + "\n\n")
        pixels = (view.image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(folder / f"images/{stem}.png")
        prior = point_prior(view, scene.points).depth_prior.numpy()
        known = np.isfinite(prior)
        full = NearestNDInterpolator(np.argwhere(known), prior[known])(*np.indices(prior.shape))
        near = Image.fromarray((255 * (1 / full - (1 / full).min()) / np.ptp(1 / full)).round().astype(np.uint8))
        near.save(folder / f"depth/{stem}.png")
        near.save(folder / f"depth_maps/depth_{stem}.png")
    (sparse / "cameras.txt").write_text("".join(cameras))
    (sparse / "images.txt").write_text("".join(images))
    names = [
        *((axis, "<f4") for axis in ("x", "y", "z", "nx", "ny", "nz")),
        *((c, "u1") for c in ("red", "green", "blue")),
    ]
    rows = np.zeros(len(scene.points.positions), names)
    for axis, values in zip("xyz", scene.points.positions.T, strict=True):
        rows[axis] = values
    for color, values in zip(("red", "green", "blue"), scene.points.colors.T, strict=True):
        rows[color] = (values * 255).round()
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    for ply in (sparse / "points3D.ply", folder / "3_views/dense/fused.ply"):
        ply.write_bytes(header.encode() + rows.tobytes())
    np.save(folder / "poses_bounds.npy", np.tile([0.0] * 15 + list(depth_bounds(scene)), (len(scene.train), 1)))


def main(
    recipe: tyro.conf.Positional[str],
    fork: tyro.conf.Positional[Path],
    path: str = "data/fern",
    images: str | None = "images_16",
    iterations: int = 300,
    seeds: tuple[int, ...] = (0, 1, 2),
    fork_seeds: tuple[int, ...] = (0, 1, 2),
    out: Path = Path("runs/beside"),
) -> None:
    """Train a recipe and the fork it is named after.

    Args:
        recipe: one of FORKS.
        fork: folder of the fork's sources.
        path: scene folder, with a COLMAP cloud from the training views.
        images: image folder within it.
        iterations: of both.
        seeds: of the recipe.
        fork_seeds: each raises the seeds that the fork fixes.
        out: folder for all of it.
    """
    n, out = iterations, out.resolve()
    marks = {"n": n, "half": n // 2, "third": n // 3, "quarter": n // 4, "sixth": n // 6, "scene": out / "llff"}
    marks |= {
        "reset": n * 2 // 5,
        "until": n * 4 // 5,
        "late": n * 19 // 20,
        "half_1": n // 2 + 1,
        "quarter_1": n // 4 + 1,
    }
    where = ["--path", path, "--no-undistort", *(["--images", images] if images else [])]
    if not (out / "llff/poses_bounds.npy").is_file():
        write_scene(SceneOptions(path=path, images=images, undistort=False).load(), out / "llff")
    kept = {"scene": Path(path).name, "iterations": n, "machine": machine(), "usual": {}}
    rows = Rows(out / "beside.json", kept)
    for seed in fork_seeds:
        run, scored = out / f"{recipe}/fork_{seed}", out / f"{recipe}/fork_scored_{seed}"
        ply = run / f"point_cloud/iteration_{n}/point_cloud.ply"
        if not ply.is_file():
            run.mkdir(parents=True, exist_ok=True)
            options = f"{FORKS[recipe].script} {_ALL.script} -s {{scene}} -m {run}".format(**marks).split()
            told = {"BESIDE_SEED": str(seed), "BESIDE_SCENE": f"{out}/llff", "BESIDE_SECONDS": f"{run}/seconds"}
            told["PYTHONPATH"] = os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])
            with (run / "log").open("w") as log:
                launched = [sys.executable, "-c", _CHILD, "--cpu", *options]
                subprocess.run(launched, cwd=fork, env=os.environ | told, check=True, stdout=log, stderr=log)
        if not (scored / "evaluation.json").is_file():
            ca_reg(["evaluate", "--ply", str(ply), *where, "--out", str(scored)])
        found = read_json(scored / "evaluation.json")
        seconds = float((run / "seconds").read_text())
        rows.add(_row(f"{recipe}: {fork.name}", seed, found, found["ply"]["gaussians"], seconds))
    for seed in seeds:
        run = out / f"{recipe}/recipe_{seed}"
        if not (run / "results.json").is_file():
            options = f"--recipe {recipe} --seed {seed} {_ALL.recipe} {FORKS[recipe].recipe}".format(**marks).split()
            ca_reg(["train", *where, *options, "--out", str(run)])
        found = read_json(run / "results.json")
        rows.add(_row(f"{recipe}: recipe", seed, found, found["gaussians"], found["processor_seconds"]))
    print(rows.file.read_text("utf-8"))


def _row(name: str, seed: int, found: dict[str, Any], gaussians: int, seconds: float) -> Row:
    """Return the figures of one training over the test views."""
    test = {name: found["mean"]["test"][name] for name in ("psnr", "ssim", "ca", "ca_exact_half")}
    return {"setting": {"recipe": name}, "seed": seed, "test": test, "gaussians": gaussians, "seconds": seconds}


if __name__ == "__main__":
    tyro.cli(main)
