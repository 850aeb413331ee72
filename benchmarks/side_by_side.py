"""One scene in several trainers, all scored by one evaluator: tables of benchmarks/integrations.md and recipes.md.

    python -m benchmarks.side_by_side benchmarks/data/forks.json --scene fern --images images_16 \
        --forks forks --iterations 300 --trainers AbsGS MVGS

``forks`` has the repositories as folders of the names in `TRAINERS`; what they import, but for CUDA, is
installed. ``--evaluator`` is the interpreter of another environment, where nerfstudio and ca-reg need other versions
of a package. Every run has a folder of its own below ``--out``; the file, of rows as of `benchmarks.paper`, is written
after each, and none is repeated.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.interpolate import NearestNDInterpolator
from scipy.spatial.transform import Rotation

from benchmarks.paper.rows import Row, Rows
from reference_trainer.evaluation.results import machine
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.depth import point_prior
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.virtual_cameras import depth_bounds

__all__ = ["EVALUATE", "EXPORT", "OPTIONS", "TRAINERS", "named", "settings", "steps", "train", "write_scene"]


def with_tests(scene: Scene) -> Scene:
    """Return a scene whose views are a test view and a training view in turn, renamed to stay in this order.

    gsplat's trainer and nerfstudio tell them apart so, by an interval of two. A test view may return.
    """
    pairs = zip(itertools.cycle(scene.test), scene.train, strict=False)
    views = [replace(view, name=f"{i:03}.png") for i, view in enumerate(itertools.chain.from_iterable(pairs))]
    return replace(scene, train=tuple(views))


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
    listed = (f"{i} {x} {y} {z} {r} {g} {b} 0\n" for i, (x, y, z, *_, r, g, b) in enumerate(rows.tolist(), start=1))
    (sparse / "points3D.txt").write_text("".join(listed))
    np.save(sparse / "confidence_dsp.npy", np.zeros((len(rows), 1)))  # of the points, for InstantSplat
    if not (folder / "sparse_3").exists():
        (folder / "sparse_3").symlink_to("sparse")
    np.save(folder / "poses_bounds.npy", np.tile([0.0] * 15 + list(depth_bounds(scene)), (len(scene.train), 1)))


_NEVER = 10**6
_LAUNCHED = "ca_reg.integrations.run --cpu --seed {seed} {option} "
_OURS = "reference_trainer.cli train --path {scene} --images {images} --out {out} --iterations {n} --monitor-every 0 "
_FORK = (
    f"-s {{fork_scene}} -m {{out}} -r 1 --images images --iterations {{n}} --position_lr_max_steps {{n}} "
    f"--save_iterations {{n}} --test_iterations {_NEVER} --port 0 --densify_from_iter {{third}} "
    "--densification_interval {sixth} "
)

_FORKS = {  # and the options of each
    "Co-Adaptation-of-3DGS": "--n_views 3 --shift_cam_start {two_thirds} --dropout_factor 0",
    "Binocular3DGS": "--n_views 3 --shift_cam_start {two_thirds}",
    "AbsGS": "",
    "MVGS": "--mv 2",
    "DropGaussian": "--n_views 3",
    "CoR-GS": "--n_views 3 --gaussiansN 2 --coreg",
    "FSGS": "--n_views 3",
    "gaussian-splatting": "",
    "3dgs-mcmc": "--init_type sfm --cap_max 20000",
    "taming-3dgs": "--densify_until_iter {n} --percent_dense 0.07 --budget 2 --mode multiplier --cams 3",
    "LightGaussian": f"--prune_iterations {_NEVER}",  # its pruning counts Gaussians, which is refused by name
    "InstantSplat": "--n_views 3",
    "mip-splatting": "",
    "RaDe-GS": "",
}
# Each with its own settings, but for where densification begins, and what would leave the coordinates of the scene.
TRAINERS = {
    "ca-reg": f"{_OURS}--densify-from 100 --densify-gradient 0.0002 --seed {{seed}} {{option}}",
    "3DGS": f"{_LAUNCHED}{{forks}}/3DGS/train.py -s {{fork_scene}} -m {{out}} --iterations {{n}} "
    "--densify_from_iter 100 --test_iterations -1 --disable_viewer",
    "gsplat": f"{_LAUNCHED}{{forks}}/gsplat/examples/simple_trainer.py default --data_dir {{both}} "
    "--data_factor 1 --test_every 2 --no-normalize-world-space --result_dir {out} --max_steps {n} "
    "--eval_steps --save_ply --ply_steps {n} --strategy.refine-start-iter 100 --disable_viewer --disable_video",
    "splatfacto": f"{_LAUNCHED}ns-train splatfacto --output-dir {{out}} "
    "--experiment-name a --timestamp b --machine.device-type cpu --max-num-iterations {n} --vis tensorboard "
    "--pipeline.model.num-downscales 0 --pipeline.model.warmup-length 100 --pipeline.model.cull-alpha-thresh 0.005 "
    "--pipeline.model.background-color black --data {both} colmap --colmap-path sparse/0 --images-path images "
    "--downscale-factor 1 --eval-mode interval --eval-interval 2 --auto-scale-poses False --center-method none "
    "--orientation-method none --assume-colmap-world-coordinate-convention False",
}
TRAINERS |= {name: f"{_LAUNCHED}{{forks}}/{name}/train.py {_FORK}{options}" for name, options in _FORKS.items()}
TRAINERS["3dgs-mcmc"] = TRAINERS["3dgs-mcmc"].replace("--port 0 ", "")
TRAINERS["LightGaussian"] = TRAINERS["LightGaussian"].replace("train.py", "train_densify_prune.py")
# Those that drop Gaussians themselves.
TRAINERS["splatfacto-ca"] = TRAINERS["splatfacto"].replace("{option} ns-train splatfacto", "ns-train splatfacto-ca")
TRAINERS["Co-Adaptation-of-3DGS --dropout_factor 0.2"] = (
    TRAINERS["Co-Adaptation-of-3DGS"].replace(" {option} ", " ").replace("dropout_factor 0", "dropout_factor 0.2")
)
TRAINERS["gsplat mcmc"] = TRAINERS["gsplat"].replace(".py default", ".py mcmc")

_RESETS = (
    "--densify_until_iter {until} --opacity_reset_interval {reset}",
    "--densify-until {until} --opacity-reset-from {reset} --opacity-reset-every {reset} --prune-size-from {reset} "
    "--sh-every 1000",
)
_FSGS = "--n_views 3 --densify_until_iter {n} --densify_grad_threshold 0.0005 --prune_from_iter {third}"
_RECIPES = {
    "inria": ("3DGS", *_RESETS),
    "absgs": (
        "AbsGS",
        f"{_RESETS[0]} --opacity_reduce_interval {{quarter}}",
        f"{_RESETS[1]} --density absgrad(ceiling_every={{quarter}})",
    ),
    "mvgs": ("MVGS", f"{_RESETS[0]} --mv 3", _RESETS[1]),
    "binocular": (
        "Binocular3DGS",
        "--shift_cam_start {half}",
        "--sh-every 1000 --loss photometric+warp(between(1.0,{half}))",
    ),
    "3dgs": (
        "CoR-GS",
        f"{_FSGS} --gaussiansN 1 --onlyrgb --start_sample_pseudo {{half}}",
        "--sh-every 500 --opacity-reset-from {half_1}",
    ),
    "corgs": (
        "CoR-GS",
        f"{_FSGS} --gaussiansN 2 --coreg --coprune --random_background --start_sample_pseudo {{quarter}}",
        "--sh-every 500 --opacity-reset-from {quarter_1} --loss photometric+co_regularization(between(1.0,{quarter}))",
    ),
    "fsgs": (
        "FSGS",
        f"{_FSGS} --start_sample_pseudo {{half}} --end_sample_pseudo {{late}} --sample_pseudo_interval {_NEVER}",
        "--sh-every 500 --opacity-reset-from {half_1} --density proximity(until={n}) --depth {fork_scene}/depth:inverse"
        " --loss photometric+pearson(between(0.05,0,{late}))+pearson(between(0.001,{late}))",
    ),
}
for recipe, (fork, theirs, ours) in _RECIPES.items():  # a recipe beside the repository that it is named after
    TRAINERS[f"{recipe}: {fork}"] = f"{_LAUNCHED}{{forks}}/{fork}/train.py {_FORK}{theirs}"
    TRAINERS[f"{recipe}: recipe"] = (
        f"{_OURS}--recipe {recipe} --densify-from {{third}} --densify-every {{sixth}} --no-auto --seed {{seed}} {ours} "
        "{option}"
    )

EXPORT = "ca_reg.integrations.run --cpu ns-export gaussian-splat --load-config {config} --output-dir {out}/export"
EVALUATE = (
    "reference_trainer.cli evaluate {ply} --scene {scene} --images {images} --split {split} {smaller} "
    "--out {out}/evaluation {scaled}"
)
OPTIONS = {
    "plain": "", "dropout": "--dropout 0.2", "noise": "--noise 0.8", "decay": "--dropout 0.2 --opacity-decay 0.995",
    "smooth": "--dropout 0.2 --opacity-decay 0.995 --smooth-depth 0.1",
}  # fmt: skip
AS_IT_IS = "3DGS as it is"
"""3DGS with all settings of its own but for the number of iterations, over which positions slow down."""
TRAINERS[AS_IT_IS] = (
    f"{_LAUNCHED}{{forks}}/3DGS/train.py -s {{fork_scene}} -m {{out}} -r 1 --iterations {{n}} "
    f"--position_lr_max_steps {{n}} --save_iterations {{n}} --test_iterations {_NEVER} --port 0"
)


SPLATFACTO_TO_THE_END = "splatfacto to the end"
"""splatfacto-ca, without dropout if plain, at full size throughout, with density control from its own step 500 on."""
TRAINERS[SPLATFACTO_TO_THE_END] = TRAINERS["splatfacto-ca"].replace("--pipeline.model.warmup-length 100 ", "{option} ")
TO_THE_END = (AS_IT_IS, SPLATFACTO_TO_THE_END)


def settings(trainer: str) -> Sequence[str]:
    """Return what a trainer is trained with: of OPTIONS those that the table shows."""
    if "{option}" not in TRAINERS[trainer]:
        return ["dropout"]
    if ": " in trainer:
        return ["plain"]
    if trainer in TO_THE_END:
        return ["plain", "dropout", "decay", *["smooth"] * (trainer == SPLATFACTO_TO_THE_END)]
    if trainer == "DropGaussian":  # which refuses a second dropout
        return ["plain", "noise"]
    return ["plain", "dropout", "noise"]


def named(trainer: str, setting: str, scene: str = "") -> dict[str, str]:
    """Return what a row is of: with the name of the scene, where the file has rows of several."""
    recipe = f"{trainer} {OPTIONS[setting]}".strip() if "{option}" in TRAINERS[trainer] else trainer
    return {"recipe": recipe} | ({"scene": scene} if trainer in TO_THE_END else {})


def steps(n: int) -> dict[str, int]:
    """Return the iterations, and the parts of them at which something begins or ends."""
    parts = {"half": n // 2, "third": n // 3, "two_thirds": n * 2 // 3, "quarter": n // 4, "sixth": n // 6}
    parts |= {"reset": n * 2 // 5, "until": n * 4 // 5, "late": n * 19 // 20}
    return parts | {"n": n, "last": n - 1, "half_1": n // 2 + 1, "quarter_1": n // 4 + 1}


_ROOT = Path(__file__).resolve().parents[1]  # before the tests in the path: their folders have names of packages
_PLYS = ("point_cloud/iteration_{n}/point_cloud.ply", "ply/point_cloud_{last}.ply", "export/splat.ply")
_TIMED = Path(__file__).resolve().with_name("timed.py")


def train(trainer: str, setting: str, seed: int, out: Path, args: argparse.Namespace) -> Row:
    """Train, export and evaluate, each in a process of its own; return the row that is kept."""
    environment = os.environ | {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}  # nerfstudio loads its checkpoints as pickles
    environment["PYTHONPATH"] = os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])
    names = vars(args) | steps(args.iterations) | {"out": out, "seed": seed, "option": OPTIONS[setting]}
    if trainer == SPLATFACTO_TO_THE_END:  # whose options are the method's own; it drops by default
        names["option"] = (OPTIONS[setting] or "--dropout 0").replace("--", "--pipeline.model.")
    names["scaled"] = "" if setting in ("plain", "noise") else "--regularizer dropout(0.2)"
    names["smaller"] = "" if args.downscale is None else f"--downscale {args.downscale}"

    def call(command: str, python: str = sys.executable, **further: object) -> float:
        timed = [python, str(_TIMED), str(out / "times.json"), str(seed)]
        timed += command.format(**names, **further).split()
        with (out / "log").open("a") as log:
            subprocess.run(timed, cwd=out, env=environment, stdout=log, stderr=log, check=True)
        return json.loads((out / "times.json").read_text("utf-8"))["seconds"]

    seconds = call(TRAINERS[trainer])
    result = out / "results.json"  # which the trainer of this package writes, and evaluate below
    if not result.is_file():
        for config in out.rglob("config.yml"):
            call(EXPORT, config=config)
        (ply,) = (out / place.format(**names) for place in _PLYS if (out / place.format(**names)).is_file())
        call(EVALUATE, args.evaluator, ply=ply)
        result = out / "evaluation" / "evaluation.json"
    found = json.loads(result.read_text("utf-8"))
    test = {name: found["mean"]["test"][name] for name in ("psnr", "ssim", "ca", "ca_exact_half")}
    pace = seconds / (args.iterations - 1)
    return {
        "setting": named(trainer, setting, Path(args.scene).name),
        "seed": seed,
        "test": test,
        "gaussians": found["gaussians"],
        "pace": pace,
    }


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("file", type=Path)
    add("--scene", type=_path, required=True)
    add("--images", default="images")
    add("--split", default="auto")
    add("--points", default="auto")
    add("--downscale", type=float)
    add("--forks", type=_path, default=_path("forks"), help="where the repositories lie")
    add("--both", type=_path, help="for gsplat and nerfstudio: a COLMAP folder of the training and test photographs, "
        "in turn (default: made of the scene)")  # fmt: skip
    add("--trainers", choices=TRAINERS, nargs="+", required=True)
    add("--seeds", type=int, nargs="+", default=[0, 1, 2])
    add("--iterations", type=int, default=500)
    add("--evaluator", default=sys.executable, help="the interpreter that evaluates, if another than this")
    add("--out", type=_path, default=_path("runs/side_by_side"))
    args = parser.parse_args()
    args.fork_scene = args.out / "llff"  # CoR-GS tells its readers by the path
    if not (args.fork_scene / "poses_bounds.npy").is_file():
        options = {name: getattr(args, name) for name in ("images", "split", "points", "downscale")}
        scene = load_scene(SceneOptions(str(args.scene), allow_test_points=True, **options))
        write_scene(with_tests(scene), args.out / "both")
        write_scene(scene, args.fork_scene)
    args.both = args.both or args.out / "both"
    rows = Rows(args.file, {"scene": args.scene.name, "iterations": args.iterations, "machine": machine(), "usual": {}})
    for seed in args.seeds:
        for trainer in args.trainers:
            for setting in settings(trainer):
                if seed not in rows.of(named(trainer, setting, args.scene.name)):
                    out = args.out / trainer.replace(" ", "_").replace(":", "") / setting / str(seed)
                    shutil.rmtree(out, ignore_errors=True)
                    out.mkdir(parents=True)
                    rows.add(train(trainer, setting, seed, out, args))


def _path(text: str) -> Path:
    return Path(text).resolve()


if __name__ == "__main__":
    main()
