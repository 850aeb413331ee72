"""What the rules that look at neighbors cost: ``OMP_NUM_THREADS=1 python -m benchmarks.neighbors``.

The points lie on a wavy surface, with a thickness of a thousandth of its width. Processor seconds of one thread, the
least of the rounds, which take turns.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import torch
import tyro
from torch import Tensor

from ca_reg import Params
from ca_reg.neighbors import _by_leaves, nearest_neighbors
from ca_reg.regularizers import parse

RULES = ("density", "geometry", "d2gs", "drop_anchors", "clustered(0.5)", "position_noise(0.1)")


def costs(counts: Sequence[int] = (10_000, 36_000, 100_000, 300_000), rounds: int = 3) -> None:
    """Print a table.

    Args:
        counts: numbers of Gaussians.
        rounds: of which the least is taken.
    """
    torch.set_num_threads(1)
    print("| Gaussians | 10 neighbors, SciPy | without | " + " | ".join(f"`{rule}`" for rule in RULES) + " |")
    print("|---:" * (3 + len(RULES)) + "|")
    for count in counts:
        x = Params(torch.full((count,), 0.5), surface(count), view_matrix=torch.eye(4), step=5_000)
        calls = {"tree": lambda x=x: nearest_neighbors(x.means, 10), "leaves": lambda x=x: _by_leaves(x.means, 10)}
        for rule in RULES:
            calls[rule] = lambda x=x, rule=rule: parse(rule).regularize(x)
            calls[rule + " again"] = again(rule, x)
        times = dict.fromkeys(calls, math.inf)
        for _ in range(rounds):
            for name, call in calls.items():
                start = time.thread_time()
                call()
                times[name] = min(times[name], time.thread_time() - start)
        cells = [f"{times['tree']:.3f} s", f"{times['leaves']:.3f} s"]
        cells += [f"{times[rule]:.3f} s; {1e3 * times[rule + ' again']:.1f} ms" for rule in RULES]
        print(f"| {count:,} | " + " | ".join(cells) + " |", flush=True)


def again(rule: str, x: Params) -> Callable[[], object]:
    """Return a step between two looks at the neighbors."""
    chain = parse(rule)
    chain.regularize(x)
    return lambda: chain.regularize(x)


def surface(count: int) -> Tensor:
    """Return points, (count, 3)."""
    g = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=g)
    points[:, 2] = 0.1 * torch.sin(6 * points[:, 0]) + 0.001 * torch.randn(count, generator=g)
    return points


if __name__ == "__main__":
    tyro.cli(costs)
