"""Kill runs at random moments and print what was found: ``PYTHONPATH=.:tests python tests/reliability/kill.py 50``."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from reliability.harness import Settings, campaign

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["main"]


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
    where = ", ".join(f"{count} {moment}" for moment, count in out.moments.most_common())
    print(f"{out.kills} kills ({where}), {out.half_written} in the middle of writing a file")
    print(f"{out.finished} runs came to their end, compared bit for bit with the uninterrupted one")
    print(f"{len(out.defects)} defects", *out.defects, sep="\n    ")
    sys.exit(bool(out.defects))


if __name__ == "__main__":
    main()
