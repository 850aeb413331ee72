"""Fuzz every reader with many files and print a table: ``PYTHONPATH=.:tests python tests/fuzz/campaign.py 20000``."""

from __future__ import annotations

import argparse
import resource
import tempfile
from pathlib import Path

import torch
from fuzz.harness import fuzz
from fuzz.targets import TARGETS

__all__ = ["main"]


def main() -> None:
    """Run the campaign that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", type=int, help="damaged files per reader")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--only", default="", help="readers whose name contains this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| reader | inputs | refused | read | defects | slowest, ms | memory, kB |")
    print("|:---|---:|---:|---:|---:|---:|---:|")
    for target in (target for target in TARGETS if options.only in target.name):
        with tempfile.TemporaryDirectory() as folder:
            out = fuzz(target, Path(folder), range(options.first, options.first + options.inputs))
        numbers = (out.inputs, out.refused, out.read, len(out.defects), f"{1e3 * out.slowest:.0f}", out.peak // 1000)
        print(f"| {target.name} | {' | '.join(map(str, numbers))} |", flush=True)
        for text, count in out.kinds().most_common():
            first = next(seed for seed, other in out.defects if other == text)
            print(f"    {count} x {text} (first with seed {first})", flush=True)
    print(f"largest resident size of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000:.0f} MB")


if __name__ == "__main__":
    main()
