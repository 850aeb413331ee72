"""Kill runs at random moments and print what was found: ``PYTHONPATH=.:tests python tests/reliability/kill.py 50``."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

from reliability.harness import Outcome, Settings, differences, inspect, run, start

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["campaign", "main"]


def campaign(settings: Settings, folder: Path, kills: int, *, seed: int = 0) -> Outcome:
    """Kill runs until so many kills are done, and then let the last one come to its end.

    Args:
        settings: of the runs.
        folder: an empty one.
        kills: how many.
        seed: of the moments, from the begin of a process to half of the time of a whole run, more of them early: so
            that a run is killed several times before it comes to its end.
    """
    whole, draw, out = folder / "whole", random.Random(seed), Outcome()
    begin = time.perf_counter()
    process = start(run, settings, whole)
    process.join()
    if process.exitcode != 0:
        raise RuntimeError("the uninterrupted run failed, see above")
    seconds = time.perf_counter() - begin
    place, step = folder / "run_0", -1
    while out.kills < kills or out.finished == 0 or place.exists():
        process = start(run, settings, place)
        process.join(0.5 * seconds * draw.random() ** 2 if out.kills < kills else None)
        process.kill()  # no effect on a process that has ended
        process.join()
        if process.exitcode < 0:
            step = inspect(place, step, out, name=place.name)
            continue
        if process.exitcode == 0:
            out.defects += [f"{place.name}: {text}" for text in differences(place, whole)]
        else:
            out.defects.append(f"{place.name} did not continue after a kill at step {step}, see above")
        out.finished += 1
        place, step = folder / f"run_{out.finished}", -1
    return out


def main() -> None:
    """Run the campaign that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kills", type=int, help="how many processes to kill")
    parser.add_argument("--path", default="synthetic", help="scene folder")
    parser.add_argument("--images", help="image folder within the scene")
    parser.add_argument("--iterations", type=int, default=60, help="of each run")
    parser.add_argument("--threads", type=int, default=1, help="of each run")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    config = TrainConfig(
        iterations=options.iterations, dropout=0.2, noise=0.4, sh_every=20, densify_from=10, densify_every=10,
        opacity_reset_from=25, opacity_reset_every=20,
    )  # fmt: skip
    scene = SceneOptions(options.path, images=options.images)
    settings = Settings(scene, config, monitor_every=15, checkpoint_every=2, threads=options.threads)
    with tempfile.TemporaryDirectory() as folder:
        out = campaign(settings, Path(folder), options.kills, seed=options.seed)
    print(out)
    sys.exit(bool(out.defects))


if __name__ == "__main__":
    main()
