"""Time steps of training with one thread and with two: ``python tests/reliability/threads.py 96 64``."""

from __future__ import annotations

import sys
import time

import torch

from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["main"]


def main(width: int, height: int, steps: int = 30) -> None:
    """Print milliseconds and milliseconds of processor time of a step, for one and two threads in turn."""
    scene = synthetic_scene(width, height, points=2_000)
    for threads in (1, 2, 1, 2):
        torch.set_num_threads(threads)
        trainer = Trainer(scene, TrainConfig(densify_every=0, initial_opacity=0.3))
        for _ in range(3):
            trainer.train_step()
        clock, processor = time.perf_counter(), time.process_time()
        for _ in range(steps):
            trainer.train_step()
        clock, processor = time.perf_counter() - clock, time.process_time() - processor
        print(f"{threads} threads: {1e3 * clock / steps:.0f} ms, of the processors {1e3 * processor / steps:.0f} ms")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
