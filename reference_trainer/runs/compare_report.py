"""The output of a comparison: results as JSON, a table with mean and spread, figures, and the list of failed runs."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reference_trainer.evaluation.pictures import file_names
from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.tables import comparison_table
from reference_trainer.files import write_text
from reference_trainer.runs.engines.engine import Failure
from reference_trainer.runs.figures import comparison_figure, dynamics_figure

__all__ = ["REPORT", "TABLE", "Comparison", "report", "save"]

REPORT = "comparison.json"
TABLE = "comparison.md"


@dataclass(frozen=True)
class Comparison:
    """The results of all runs on one scene.

    Args:
        runs: for every strategy the content of ``results.json`` of each finished seed.
        failures: runs that did not finish, and why.
    """

    runs: dict[str, list[dict[str, Any]]]
    failures: dict[str, Failure]


def save(comparison: Comparison, out: Path) -> None:
    """Write the results as JSON, and the table if any run finished.

    Args:
        comparison: the results.
        out: folder of the comparison.
    """
    write_json(out / REPORT, {**dataclasses.asdict(comparison), "machine": machine()})
    if comparison.runs:
        write_text(out / TABLE, comparison_table(comparison.runs) + "\n")


def report(comparisons: Mapping[Path, Comparison], *, say: Callable[[str], None] = print) -> None:
    """Print the table of every scene, draw the figures of its first seed, and name the runs that failed.

    Args:
        comparisons: the results by folder.
        say: receives the text.
    """
    for out, comparison in comparisons.items():
        say("")
        if len(comparisons) > 1:
            say(f"{out.name}:")
            say("")
        if comparison.runs:
            _report(comparison, out, say)
    failed = [(out, name, why) for out, of in comparisons.items() for name, why in of.failures.items()]
    if failed:
        say("")
        finished = sum(len(runs) for of in comparisons.values() for runs in of.runs.values())
        say(f"{len(failed)} of {finished + len(failed)} runs FAILED; the same command tries them again:")
        for out, name, why in failed:
            say(f"FAILED {name}: {why.error} ({out / REPORT} has the traceback)")


def _report(comparison: Comparison, out: Path, say: Callable[[str], None]) -> None:
    """Print the table of one scene and draw its figures."""
    say(comparison_table(comparison.runs))
    first = {name: out / name / f"seed_{of[0]['config']['seed']}" for name, of in comparison.runs.items()}
    say("")
    try:
        dynamics_figure(first, out / "dynamics.png")
        say(f"CA and PSNR against the iteration: {out / 'dynamics.png'}")
    except (FileNotFoundError, ValueError) as error:  # runs of --monitor-every 0, or shorter than the first measurement
        say(f"no figure of CA and PSNR against the iteration: {error}")
    views = next(iter(comparison.runs.values()))[0]["views"]
    splits = {view["split"] for view in views}
    for split in sorted(splits - {"train"}) or splits:
        for name in file_names([view["name"] for view in views if view["split"] == split]):
            comparison_figure(first, out / f"{split}_{name}.png", view=name, split=split)
            say(f"the pictures of each strategy: {out / f'{split}_{name}.png'}")
    say(f"a page about the first seed of each: ca-reg report {shlex.join(map(str, first.values()))}")
    say(f"table and all numbers: {out / TABLE}, {out / REPORT}; curves: tensorboard --logdir {shlex.quote(str(out))}")
