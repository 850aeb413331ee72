"""One scene in several trainers, plain and with dropout, all scored by one evaluator: a table of docs/integrations.md.

    PYTHONPATH=tests python -m benchmarks.side_by_side docs/data/side_by_side.json --scene fern --images images_16 \
        --train fern3 --both fern6 --3DGS gaussian-splatting --gsplat gsplat/examples

``fern3`` and ``fern6`` are COLMAP folders with the training photographs, and with those of the test as every second one
by name. The last two are where the scripts lie; what they import, but for CUDA, is installed. Every run has a folder of
its own below ``--out``; the file, of rows as of `ca-reg study paper`, is written after each, and none is repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from reference_trainer.evaluation.results import machine
from reference_trainer.studies.paper.rows import Row, Rows

__all__ = ["TRAINERS", "train"]

# Each with its own settings, but for where densification begins, and what would leave the coordinates of the scene.
TRAINERS = {
    "ca-reg": "reference_trainer.cli train --path {scene} --images {images} --out {out} --iterations {iterations} "
    "--densify-from 100 --densify-gradient 0.0002 --monitor-every 0 --seed {seed} {dropout}",
    "3DGS": "ca_reg.integrations.run --cpu --seed {seed} {dropout} train.py -s {train} -m {out} "
    "--iterations {iterations} --densify_from_iter 100 --test_iterations -1 --disable_viewer",
    "gsplat": "ca_reg.integrations.run --cpu --seed {seed} {dropout} simple_trainer.py default --data_dir {both} "
    "--data_factor 1 --test_every 2 --no-normalize-world-space --result_dir {out} --max_steps {iterations} "
    "--eval_steps --save_ply --ply_steps {iterations} --strategy.refine-start-iter 100 --disable_viewer "
    "--disable_video",
    "splatfacto": "ca_reg.integrations.run --cpu --seed {seed} {dropout} ns-train splatfacto --output-dir {out} "
    "--experiment-name a --timestamp b --machine.device-type cpu --max-num-iterations {iterations} --vis tensorboard "
    "--pipeline.model.num-downscales 0 --pipeline.model.warmup-length 100 --pipeline.model.cull-alpha-thresh 0.005 "
    "--pipeline.model.background-color black --data {both} colmap --colmap-path sparse/0 --images-path images "
    "--downscale-factor 1 --eval-mode interval --eval-interval 2 --auto-scale-poses False --center-method none "
    "--orientation-method none --assume-colmap-world-coordinate-convention False",
}
# The method of this package has dropout of its own.
TRAINERS["splatfacto-ca"] = TRAINERS["splatfacto"].replace("{dropout} ns-train splatfacto", "ns-train splatfacto-ca")
EXPORT = "ca_reg.integrations.run --cpu ns-export gaussian-splat --load-config {config} --output-dir {out}/export"
PLYS = ("point_cloud", "splat")
EVALUATE = "reference_trainer.cli evaluate --ply {ply} --scene {scene} --images {images} --out {out}/evaluation"
TIMED = Path(__file__).resolve().with_name("timed.py")
SETTINGS = {"plain": "", "dropout": "--dropout 0.2"}


def train(trainer: str, setting: str, seed: int, out: Path, args: argparse.Namespace) -> Row:
    """Train, export and evaluate, each in a process of its own; return the row that is kept."""
    environment = os.environ | {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}  # nerfstudio loads its checkpoints as pickles
    folder = vars(args).get(trainer, out)
    names = vars(args) | {"out": out, "seed": seed, "dropout": SETTINGS[setting]}

    def call(command: str, python: str = sys.executable, **further: object) -> float:
        timed = [python, str(TIMED), str(out / "times.json"), str(seed)]
        timed += command.format(**names, **further).split()
        with (out / "log").open("a") as log:
            subprocess.run(timed, cwd=folder, env=environment, stdout=log, stderr=log, check=True)
        return json.loads((out / "times.json").read_text("utf-8"))["seconds"]

    seconds = call(TRAINERS[trainer])
    result = out / "results.json"  # which the trainer of this package writes, and evaluate below
    if not result.is_file():
        for config in out.rglob("config.yml"):
            call(EXPORT, config=config)
        (ply,) = (path for path in out.rglob("*.ply") if path.stem in (*PLYS, f"point_cloud_{args.iterations - 1}"))
        call(EVALUATE + (" --regularizer dropout(0.2)" if SETTINGS[setting] else ""), args.evaluator, ply=ply)
        result = out / "evaluation" / "evaluation.json"
    found = json.loads(result.read_text("utf-8"))
    test = {name: found["mean"]["test"][name] for name in ("psnr", "ssim", "ca", "ca_exact_half")}
    pace = seconds / (args.iterations - 1)
    return {
        "setting": named(trainer, setting),
        "seed": seed,
        "test": test,
        "gaussians": found["gaussians"],
        "pace": pace,
    }


def named(trainer: str, setting: str) -> dict[str, str]:
    """Return what a row is of."""
    return {"recipe": f"{trainer} {SETTINGS[setting]}".strip() if is_told(trainer) else trainer}


def is_told(trainer: str) -> bool:
    """Whether the launcher tells a trainer to drop Gaussians; else it always does."""
    return "{dropout}" in TRAINERS[trainer]


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("file", type=Path)
    for name in ("--scene", "--train", "--both", "--3DGS", "--gsplat"):
        add(name, type=lambda path: Path(path).resolve(), required=True)
    add("--images", default="images")
    add("--trainers", choices=TRAINERS, nargs="+", default=list(TRAINERS))
    add("--seeds", type=int, nargs="+", default=[0, 1, 2])
    add("--iterations", type=int, default=500)
    add(
        "--evaluator",
        default=sys.executable,
        help="the interpreter that evaluates, if another than the one that trains",
    )
    add("--out", type=lambda path: Path(path).resolve(), default=Path("runs/side_by_side").resolve())
    args = parser.parse_args()
    rows = Rows(args.file, {"scene": args.scene.name, "machine": machine(), "usual": {}})
    for seed in args.seeds:
        for trainer in args.trainers:
            for setting in SETTINGS if is_told(trainer) else ["dropout"]:
                if seed not in rows.of(named(trainer, setting)):
                    out = args.out / trainer / setting / str(seed)
                    shutil.rmtree(out, ignore_errors=True)
                    out.mkdir(parents=True)
                    rows.add(train(trainer, setting, seed, out, args))


if __name__ == "__main__":
    main()
