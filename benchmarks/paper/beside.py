"""Tables that set the kept rows beside something else: the paper's figures, another size, more seeds, its formula."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from benchmarks.paper.claims import AT_PAPER_SIZE, CLAIMS, Check, Setting
from benchmarks.paper.comparison import FEW_SEEDS, RowStore, differences, interval, judged
from benchmarks.paper.rows import value
from benchmarks.paper.scenes import PAPER_SIZE, PAPER_STEPS
from reference_trainer.evaluation.tables import markdown_table

__all__ = ["PAPER_TABLE", "beside_table", "origins_table", "rates_table", "seeds_table", "sizes_table"]

PAPER_TABLE: Mapping[str, Mapping[str, tuple[tuple[float, float], ...]]] = {
    "LLFF": {
        "3dgs": ((19.36, 8.206), (20.20, 2.340), (19.91, 2.300)),
        "dngaussian": ((18.93, 7.645), (19.43, 3.821), (19.15, 5.071)),
        "fsgs": ((20.43, 4.758), (20.82, 2.205), (20.59, 2.020)),
        "corgs": ((20.17, 5.159), (20.64, 1.617), (20.28, 3.867)),
        "binocular": ((21.44, 1.951), (22.12, 0.978), (22.12, 0.762)),
    },
    "DTU": {
        "3dgs": ((17.30, 2.869), (17.75, 2.263), (17.27, 2.390)),
        "dngaussian": ((18.91, 5.744), (19.86, 1.917), (19.52, 2.641)),
        "fsgs": ((17.34, 3.313), (17.86, 2.376), (17.81, 2.245)),
        "corgs": ((19.21, 1.199), (19.94, 0.611), (19.54, 0.814)),
        "binocular": ((20.71, 1.579), (21.03, 1.146), (20.92, 1.548)),
    },
    "Blender": {
        "3dgs": ((23.54, 3.937), (24.14, 2.015), (23.65, 3.136)),
        "dngaussian": ((23.41, 4.947), (23.98, 2.585), (23.43, 4.922)),
        "binocular": ((23.81, 1.981), (24.24, 1.539), (24.24, 1.179)),
    },
}
"""The paper's main tables: PSNR and CA (1e-3) of new views, plain, with dropout of 0.2 and with opacity noise."""

_OF_DATA_SET = {"LLFF": ("fern",), "DTU": ("dtu-scan24", "dtu-scan65"), "Blender": ("lego",)}
_WAYS: Mapping[str, Setting] = {
    "plain": {},
    "dropout": {"regularizer": "dropout(0.2)"},
    "noise": {"regularizer": "noise(0.8)"},
}
_WEAKER: Setting = {"regularizer": "noise(0.4)"}


def beside_table(store: RowStore) -> str:
    """Return the paper's main table beside the kept rows at both sizes, by data set and system.

    Rows that the paper has and we have not are left out. CA is left to the share in the paper's protocol, a ratio of
    means, as the paper's figures are means; ± is two standard errors. The paper tunes the scale of the noise for each
    system: beside 0.8 stands 0.4, where there are rows of it.
    """
    columns = ["", "system", "of", "dropout gains", "noise gains", "CA left by dropout", "by noise", "by PSNR"]
    columns += ["noise of 0.4 gains", "leaves"]
    lines = []
    for data_set, systems in PAPER_TABLE.items():
        for system, figures in systems.items():
            ours = [
                (scene, of)
                for small in _OF_DATA_SET[data_set]
                for of in (store, _at_paper_size(store))
                for scene in _sized(small, of)
            ]
            rows = [_ours(scene, system, of) for scene, of in ours]
            if any(rows):
                paper = dict(zip(_WAYS, figures, strict=True))
                gains = [f"{paper[way][0] - paper['plain'][0]:+.2f}" for way in ("dropout", "noise")]
                lines.append([data_set, system, "the paper", *gains, *_left_and_order(paper), "", ""])
                lines += [[data_set, system, *row] for row in rows if row]
    return markdown_table([dict(zip(columns, line, strict=True)) for line in lines], columns) if lines else ""


def sizes_table(store: RowStore) -> str:
    """Return the verdicts on the scenes of the paper's data sets at both sizes, of claims that have rows at both.

    A single seed at the paper's size has no verdict: the table says whether it lies where the claim says.
    """
    large, lines = _at_paper_size(store), []
    for name, claim in CLAIMS.items():
        there = replace(claim, scenes=tuple(PAPER_SIZE))
        at_size = judged(there, large) if claim.checks and name.isdigit() else {}
        cells: dict[str, object] = {}
        for scene, (seeds, end) in at_size.items():
            before = judged(claim, store).get(_small(scene))
            found = [(check, differences(check, scene, large)) for check in claim.checks]
            agrees = all(check.low < statistics.fmean(of) < check.high for check, of in found)
            after = end if seeds > 1 else "as claimed" if agrees else "not as claimed"
            cells[_small(scene)] = f"{f'{before[1]} ({before[0]})' if before else 'n/a'} → {after} ({seeds})"
        if cells:
            lines.append({"": name, "claim": claim.says, **cells})
    return markdown_table(lines, ["", "claim", *sorted({key for line in lines for key in line} - {"", "claim"})])


def seeds_table(store: RowStore) -> str:
    """Return the verdicts of three seeds and of all where there are more, in bold if they differ; "" without any."""
    columns = ["", "claim", "scene", "three seeds", "all", "seeds"]
    few, lines = RowStore(store.folder, store.recipe, store.iterations, seeds=FEW_SEEDS), []
    for name, claim in CLAIMS.items():
        before = judged(claim, few) if name not in AT_PAPER_SIZE else {}
        for scene, (_, end) in judged(claim, store).items() if before else ():
            counts = [len(differences(check, scene, store)) for check in claim.checks]
            if max(counts) > FEW_SEEDS and scene in before:
                seeds = " to ".join(map(str, sorted({min(counts), max(counts)})))
                found = end if end == before[scene][1] else f"**{end}**"
                cells = name, claim.says, scene, before[scene][1], found, seeds
                lines.append(dict(zip(columns, cells, strict=True)))
    return markdown_table(lines, columns) if lines else ""


def rates_table(store: RowStore) -> str:
    """Return what the exact score is at the protocol's drop rate, relative to that at 1/2, of models with dropout.

    The paper's formula has the drop rate in the factor ``p (1 - p)`` alone, which is largest at 1/2.
    """
    lines: list[dict[str, object]] = []
    for rate in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        setting, drop = {"regularizer": f"dropout({rate})"}, 1 - (1 - rate) / 2
        check = Check("test ca_exact", setting, setting, to="test ca_exact_half", relative=True)
        found = {scene: differences(check, scene, store) for scene in store.scenes}
        cells = {scene: f"{1 + statistics.fmean(of):.2f}" for scene, of in found.items() if of}
        if cells:
            formula = 4 * drop * (1 - drop)
            lines.append({"trained at": f"{rate:g}", "dropped": f"{drop:g}", "p (1 - p)": f"{formula:.2f}", **cells})
    scenes = [scene for scene in store.scenes if any(scene in line for line in lines)]
    return markdown_table(lines, ["trained at", "dropped", "p (1 - p)", *scenes]) if lines else ""


def origins_table(store: RowStore) -> str:
    """Return where the rows of each scene were made: processor or card, and commits, "changed" if files differed."""
    lines = []
    for scene, rows in store.scenes.items():
        of = [row for row in rows.rows if row["setting"]["iterations"] == store.iterations]
        machines = dict.fromkeys(row.get("device") or row["cpu"] for row in of)
        for machine in machines:
            commits = Counter(row["commit"] or "unknown" for row in of if (row.get("device") or row["cpu"]) == machine)
            named = {commit: f"`{commit[:8]}`" + " changed" * commit.endswith("-dirty") for commit in commits}
            said = ", ".join(f"{named[commit]}: {count}" for commit, count in commits.most_common())
            lines.append({"scene": scene, "on": machine, "trainings": commits.total(), "by commit": said})
    return markdown_table(lines, ["scene", "on", "trainings", "by commit"])


def _at_paper_size(store: RowStore) -> RowStore:
    """Return the rows of the paper's number of steps in the same folder."""
    return RowStore(store.folder, store.recipe, PAPER_STEPS)


def _small(scene: str) -> str:
    """Return the scene of which one of the paper's size is made."""
    return scene.rpartition("-")[0]


def _sized(small: str, of: RowStore) -> list[str]:
    """Return the scene if the rows are of few steps, else those of the paper's size that are made of it."""
    names = [small] if of.iterations != PAPER_STEPS else [scene for scene in PAPER_SIZE if _small(scene) == small]
    return [name for name in names if name in of.scenes]


def _ours(scene: str, system: str, store: RowStore) -> list[str]:
    """Return a row of `beside_table`; [] if a way of training is missing."""
    named = {} if system == "3dgs" else {"recipe": system}
    settings = {way: {**setting, **named} for way, setting in _WAYS.items()}
    rows = {way: store.of(scene, setting) for way, setting in settings.items()}
    if not all(rows.values()):
        return []
    seeds = {len(of) for of in rows.values()}
    means = {
        way: (statistics.fmean(value(row, "test psnr") for row in of.values()),
              1e3 * statistics.fmean(value(row, "test ca") for row in of.values()))
        for way, of in rows.items()
    }  # fmt: skip
    gains = [_gain(scene, settings[way], settings["plain"], store) for way in ("dropout", "noise")]
    weaker = {**_WEAKER, **named}
    of_weaker = ["", ""]
    if found := store.of(scene, weaker):
        left = 1e3 * statistics.fmean(value(row, "test ca") for row in found.values()) / means["plain"][1]
        of_weaker = [_gain(scene, weaker, settings["plain"], store), f"{left:.2f}"]
    return [f"{scene} ({min(seeds)})", *gains, *_left_and_order(means), *of_weaker]


def _gain(scene: str, setting: Setting, plain: Setting, store: RowStore) -> str:
    """Return the mean gain in PSNR, ± two standard errors if there are several seeds."""
    gains = differences(Check("test psnr", setting, plain), scene, store)
    mean, error = interval(gains)
    return f"{mean:+.2f}" + (f" ± {error:.2f}" if len(gains) > 1 else "")


def _left_and_order(figures: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the shares of the plain CA that dropout and noise leave, and the three ways from high PSNR to low."""
    left = [f"{figures[way][1] / figures['plain'][1]:.2f}" for way in ("dropout", "noise")]
    return [*left, " > ".join(sorted(figures, key=lambda way: -figures[way][0]))]
