"""The demonstration: the built-in scene from three views, with and without the regularizers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from reference_trainer.runs.compare import compare, strategies
from reference_trainer.runs.compare_report import Comparison, report
from reference_trainer.runs.engines.processes import Processes
from reference_trainer.runs.grid import Running
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import with_preset

__all__ = ["demo"]


def demo(
    out: Path, *, iterations: int = 1000, seeds: Sequence[int] = (0,), jobs: int = 2, say: Callable[[str], None] = print
) -> Comparison:
    """Train the built-in scene with every strategy that samples, and report.

    Args:
        out: folder for everything; an interrupted demo continues.
        iterations: training steps of each run.
        seeds: of the runs.
        jobs: runs at a time.
        say: receives the text.
    """
    config = with_preset("fsgs", iterations=iterations, opacity_reset_every=0, densify_from=min(500, iterations // 4))
    chosen = strategies(["baseline", "dropout", "noise", "both"], config)
    say(f"Training the built-in scene (3 views) with {', '.join(chosen)}: {iterations} steps each, {jobs} at a time.")
    running = Running(Processes(jobs), monitor_every=max(1, iterations // 5), say=say)
    comparisons = compare({out: SceneOptions("synthetic")}, chosen, seeds, running)
    report(comparisons, say=say)
    return comparisons[out]
