"""Kill a run at every file operation that it makes: ``PYTHONPATH=.:tests python tests/reliability/writes.py``."""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from reliability.harness import Outcome, Settings, differences, inspect, run, start
from reliability.operations import listed, perform

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig

__all__ = ["SHORT", "campaign", "main"]

_RECOVERY = 30  # operations, about what a continued run does before its first step


SHORT = Settings(
    SceneOptions("synthetic", downscale=10, views=2),  # 16x12 pixels: a run of a second
    TrainConfig(
        iterations=5, dropout=0.2, noise=0.3, sh_every=2, densify_from=1, densify_every=2, densify_gradient=2e-3
    ),
    monitor_every=2,  # lines of the log that a kill leaves beyond the checkpoint
    checkpoint_every=3,
    auto=True,
)
"""Every kind of file that a run writes, the log and the checkpoint several times."""


def campaign(
    settings: Settings, folder: Path, *, first: int = 1, every: int = 1, power: bool = False, again: int | None = None
) -> tuple[list[str], Outcome]:
    """Kill a run at one operation after the other; continue it, and compare it with the uninterrupted one.

    Args:
        settings: of the runs.
        folder: an empty one.
        first: operation to begin with, from 1 on.
        every: how many operations to go on by.
        power: pretend power cuts (`watch`).
        again: seed of a second kill, while what the first has left is continued; None leaves that out.

    Returns:
        The operations of a run, in their order, and what was found.
    """
    whole, out, draw = folder / "whole", Outcome(), random.Random(again)
    if _ended(settings, whole) != 0:
        raise RuntimeError("the uninterrupted run failed, see above")
    operations = listed(whole).read_text().splitlines()

    def finish(place: Path, name: str) -> None:
        code = _ended(settings, place)
        found = ["did not continue, see above"] if code else differences(place, whole)
        out.defects += [f"{name}: {text}" for text in found]
        out.finished += 1
        shutil.rmtree(place)

    for number in range(first, len(operations) + 1, every):
        name, place, copy = f"{number} ({operations[number - 1]})", folder / "run", folder / "copy"
        step = -1
        if _ended(settings, place, number, power) < 0:
            step = inspect(place, step, out, name=name)
        else:
            out.defects.append(f"{name}: ended without that operation")
        if again is not None and place.exists():
            shutil.copytree(place, copy)
        finish(place, name)
        if again is not None:
            second = draw.randint(1, _RECOVERY)
            name += f" and {second} of the continued run"
            if _ended(settings, copy, second, power) < 0:
                inspect(copy, step, out, name=name)
            finish(copy, name)
    return operations, out


def main() -> None:
    """Run the campaign that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1, help="operation to begin with")
    parser.add_argument("--every", type=int, default=1, help="how many operations to go on by")
    parser.add_argument("--power", action="store_true", help="power cuts: half of what was not synced is lost, too")
    parser.add_argument("--again", type=int, help="seed of a second kill, of each continued run")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        operations, out = campaign(SHORT, Path(folder), **vars(options))
    kinds = Counter(name.split()[0] for name in operations)
    print(f"{len(operations)} operations:", ", ".join(f"{count} {kind}" for kind, count in kinds.most_common()))
    print(out)
    sys.exit(bool(out.defects))


def _ended(settings: Settings, place: Path, fatal: int | None = None, power: bool = False) -> int:
    """Begin or continue a run, and return its exit code."""
    process = start(perform, place, fatal, power, run, settings, place)
    process.join()
    return int(process.exitcode)


if __name__ == "__main__":
    main()
