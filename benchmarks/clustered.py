"""Do models that hide behind their neighbors look worse? Scores with masks that drop neighbors together.

    python -m benchmarks.clustered benchmarks/data/clustered.json runs/fern/*/seed_*

For every run: the variance of the test views' colors when half of the Gaussians are dropped, independently (exact, no
draw) and in clusters of 11 neighbors (`samples` draws), both over the pixels that the exact score counts.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from ca_reg import CAScore
from ca_reg.regularizers import parse
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.tables import format_mean_std, markdown_table
from reference_trainer.evaluation.trained_model import MaskedRenders
from reference_trainer.runs.run import load_run, model_of

__all__ = ["measure", "table"]


@torch.no_grad()
def measure(run: Path, samples: int) -> dict[str, Any]:
    """Return both variances of a finished run, the means over its test views, and their ratio."""
    trainer = load_run(run)
    model = model_of(trainer)
    exact = model.exact_ca_score(drop_rate=0.5)
    sums = [0.0, 0.0]
    for index, view in enumerate(trainer.scene.test):
        alone = exact(model.gaussians.opacities, view)
        clusters = CAScore(MaskedRenders(model), samples=samples, ddof=1, regularizer=parse("clustered(0.5)"))
        together = clusters(model.gaussians.params(view.camera, step=trainer.step), view, index=index)
        for place, result in enumerate((alone, together)):
            sums[place] += result.variance[alone.visible].double().mean().item()
    found = [total / len(trainer.scene.test) for total in sums]
    return {"independent": found[0], "clustered": found[1], "ratio": found[1] / found[0]}


def table(rows: dict[str, list[dict[str, Any]]]) -> str:
    """Return one row per setting, means and standard deviations over the seeds."""
    cells = [
        {"trained with": name}
        | {key: format_mean_std([one[key] for one in of], unit=unit) for key, unit in _COLUMNS.items()}
        for name, of in rows.items()
    ]
    return markdown_table(cells, ["trained with", *_COLUMNS])


_COLUMNS = {"independent": 1e-3, "clustered": 1e-3, "ratio": 1.0}


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--samples", type=int, default=32)
    args = parser.parse_args()
    rows: dict[str, list[dict[str, Any]]] = {}
    for run in args.runs:
        rows.setdefault(run.parent.name, []).append(measure(run, args.samples))
        write_json(args.file, {"samples": args.samples, "rows": rows})
    print(table(rows), end="")


if __name__ == "__main__":
    main()
