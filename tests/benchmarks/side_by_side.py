"""One scene in several trainers, all scored by one evaluator: tables of docs/integrations.md and docs/recipes.md.

    PYTHONPATH=tests python -m benchmarks.side_by_side docs/data/forks.json --scene fern --images images_16 \
        --forks forks --iterations 300 --trainers AbsGS MVGS

``forks`` has the repositories as folders of the names in `trainers.TRAINERS`; what they import, but for CUDA, is
installed. Every run has a folder of its own below ``--out``; the file, of rows as of `ca-reg study paper`, is written
after each, and none is repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.fork_scene import write_scene
from benchmarks.trainers import EVALUATE, EXPORT, OPTIONS, TRAINERS, named, settings, steps
from reference_trainer.evaluation.results import machine
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.paper.rows import Row, Rows

__all__ = ["train"]

_ROOT = Path(__file__).parents[2]  # before the tests in the path: their folders have names of packages
_PLYS = ("point_cloud/iteration_{n}/point_cloud.ply", "ply/point_cloud_{last}.ply", "export/splat.ply")
_TIMED = Path(__file__).resolve().with_name("timed.py")


def train(trainer: str, setting: str, seed: int, out: Path, args: argparse.Namespace) -> Row:
    """Train, export and evaluate, each in a process of its own; return the row that is kept."""
    environment = os.environ | {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}  # nerfstudio loads its checkpoints as pickles
    environment["PYTHONPATH"] = os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])
    names = vars(args) | steps(args.iterations) | {"out": out, "seed": seed, "option": OPTIONS[setting]}
    names["scaled"] = "--regularizer dropout(0.2)" if setting == "dropout" else ""

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
        "setting": named(trainer, setting),
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
    add("--forks", type=_path, default=_path("forks"), help="where the repositories lie")
    add("--both", type=_path, help="for gsplat and nerfstudio: a COLMAP folder of the training and test photographs")
    add("--trainers", choices=TRAINERS, nargs="+", required=True)
    add("--seeds", type=int, nargs="+", default=[0, 1, 2])
    add("--iterations", type=int, default=500)
    add("--evaluator", default=sys.executable, help="the interpreter that evaluates, if another than this")
    add("--out", type=_path, default=_path("runs/side_by_side"))
    args = parser.parse_args()
    args.fork_scene = args.out / "llff"  # CoR-GS tells its readers by the path
    if not (args.fork_scene / "poses_bounds.npy").is_file():
        write_scene(load_scene(SceneOptions(str(args.scene), images=args.images)), args.fork_scene)
    rows = Rows(args.file, {"scene": args.scene.name, "iterations": args.iterations, "machine": machine(), "usual": {}})
    for seed in args.seeds:
        for trainer in args.trainers:
            for setting in settings(trainer):
                if seed not in rows.of(named(trainer, setting)):
                    out = args.out / trainer.replace(" ", "_").replace(":", "") / setting / str(seed)
                    shutil.rmtree(out, ignore_errors=True)
                    out.mkdir(parents=True)
                    rows.add(train(trainer, setting, seed, out, args))


def _path(text: str) -> Path:
    return Path(text).resolve()


if __name__ == "__main__":
    main()
