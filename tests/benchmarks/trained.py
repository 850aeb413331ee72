"""Tables of the docs from trainings: what is kept of many runs, small enough for the repository, and what shows it.

``keep`` reads the ``results.json`` of runs, finished by whatever command, and writes one small JSON file with the
figures of every seed; ``table`` prints the Markdown table of such a file; ``write`` puts it into a page, between
``<!-- trained NAME -->`` and ``<!-- end -->``, where NAME is the file without its ending.

    PYTHONPATH=tests python -m benchmarks.trained keep docs/data/regularizers.json runs/fern/*/seed_*
    PYTHONPATH=tests python -m benchmarks.trained write docs/regularizers.md
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from reference_trainer.evaluation.results import format_mean_std, markdown_table, write_json
from reference_trainer.training.config import TrainConfig

__all__ = ["keep", "table", "write"]

_QUALITY = {
    "psnr": ("test PSNR", 1.0),
    "ssim": ("SSIM", 1.0),
    "ca": ("CA", 1e-3),
    "ca_exact_half": ("exact CA at 1/2", 1e-3),
}
_OWN = {"gaussians": ("Gaussians, k", 1e3), "processor_seconds": ("processor s", 1.0)}
_BESIDE = {"seconds_per_iteration": ("s/iteration", 1.0)}  # in `side_by_side`
_MARKS = re.compile(r"(<!-- trained (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def keep(runs: Iterable[Path]) -> dict[str, Any]:
    """Return the figures of finished runs by setting, with the machine of the first.

    A setting is named by its regularizers, and by what else differs from most of the runs.
    """
    found = [json.loads((run / "results.json").read_text("utf-8")) for run in runs]
    if not found:
        raise SystemExit("expected folders of finished runs (with a results.json), got none.")
    configs = [result["config"] for result in found]
    usual = {name: _most([config[name] for config in configs]) for name in configs[0]}
    rows: dict[str, list[dict[str, Any]]] = {}
    for result in found:
        test = result["mean"]["test"]
        figures = {"seed": result["config"]["seed"]} | {name: test[name] for name in _QUALITY}
        rows.setdefault(_label(result["config"], usual), []).append(figures | {name: result[name] for name in _OWN})
    shared = {name: value for name, value in usual.items() if value != getattr(TrainConfig(), name)}
    return {"scene": found[0]["scene"], "settings": shared, "machine": found[0]["machine"], "rows": rows}


def table(kept: Mapping[str, Any]) -> str:
    """Return one row per setting, means and sample standard deviations over its seeds; CA in units of 1e-3."""
    first = next(iter(kept["rows"].values()))[0]
    columns = {name: of for name, of in (_QUALITY | _OWN | _BESIDE).items() if name in first}
    rows = [
        {"setting": f"`{label}`" if label != "none" else label, "seeds": len(of)}
        | {
            title: format_mean_std([math.nan if run[name] is None else run[name] for run in of], unit=unit)
            for name, (title, unit) in columns.items()
        }
        for label, of in kept["rows"].items()
    ]
    return markdown_table(rows, ["setting", "seeds", *(title for title, _ in columns.values())])


def write(page: Path, data: Path) -> str:
    """Return the text of a page with every table between its marks made again."""

    def made(match: re.Match[str]) -> str:
        return f"{match[1]}{table(json.loads((data / f'{match[2]}.json').read_text('utf-8')))}{match[3]}"

    return _MARKS.sub(made, page.read_text("utf-8"))


def _label(config: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """Return the expression of the regularizers, and the other settings that are not the usual ones."""
    own = [f"{name}({config[name]:g})" for name in ("dropout", "noise") if config[name]]
    regularizers = " + ".join([*own, *([config["regularizer"]] if config["regularizer"] else [])])
    apart = {"seed", "dropout", "noise", "regularizer"}
    others = [f"{name}={value}" for name, value in config.items() if name not in apart and value != usual[name]]
    return ", ".join([*([regularizers] if regularizers else []), *others]) or "none"


def _most(values: Sequence[Any]) -> Any:
    """Return the value that occurs most often."""
    return max(values, key=values.count)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    keeping = commands.add_parser("keep")
    keeping.add_argument("file", type=Path)
    keeping.add_argument("runs", type=Path, nargs="+")
    commands.add_parser("table").add_argument("file", type=Path)
    commands.add_parser("write").add_argument("page", type=Path)
    args = parser.parse_args()
    if args.command == "keep":
        write_json(args.file, keep(args.runs))
    elif args.command == "table":
        print(table(json.loads(args.file.read_text("utf-8"))), end="")
    else:
        args.page.write_text(write(args.page, args.page.parent / "data"), "utf-8")


if __name__ == "__main__":
    main()
