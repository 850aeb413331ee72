"""The later choices of the setting for few photographs, by the rows of `benchmarks.setting`; see benchmarks/choices.md.

python -m benchmarks.choices benchmarks/data/setting.json    # or quality.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

from benchmarks.paper.rows import value
from benchmarks.paper.scenes import SCENES
from benchmarks.setting import (
    ANY_COLOR,
    BINOCULAR,
    DISTILLED,
    ELSEWHERE,
    FEWEST,
    HALF,
    HELD_OUT,
    LATER,
    MEAN_BACKGROUND,
    ONE_EXPOSURE,
    OTHER_KINDS,
    PLANES,
    REFERENCES,
    RELATIVE,
    SHOWN,
    THIRD,
    TODAY,
    TWICE,
    Row,
    references_of,
    rows_of,
)
from benchmarks.start_scenes import from_dense, from_today
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std

__all__ = [
    "BESIDE_BINOCULAR", "BESIDE_DROPOUT", "BESIDE_TWO", "BY_ANY_COLOR", "BY_DEFAULT", "BY_SMOOTH",
    "BY_TODAYS", "CHOICES", "DROPOUT_ALONE",
    "ENSEMBLE", "EVEN", "EVEN_OVER_PLAIN", "KINDS", "LEFT_OUT", "PLAIN_ENSEMBLE", "QUALITY", "SHARPER", "SHORTER",
    "SLOWER_MEANS", "SMOOTH", "SMOOTHLY", "SMOOTH_AND_EVEN", "TODAYS_BESIDE_BINOCULAR", "TWO_BESIDE_ONE",
    "TWO_BY_TODAYS", "UNEVEN", "WITHOUT",
    "Choice", "figures_of", "from_same_start", "gains_of", "name_on", "pairs_of", "tables",
]  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """Candidates of a choice, and what they are held against.

    Args:
        names: of what the candidates add to the recipe, or of the points from which it begins.
        seeds: of the recipe's trainings over whose mean they gain.
        tried: the candidates' seeds.
        figure: whether all pixels of the held-out views count, or the shared ones.
        starts: whether the names are of points.
        begun: names a scene with the start of all.
        over: the recipe.
        even: whether photographs are made equally bright, in both arms.
    """

    names: tuple[str, ...]
    seeds: Sequence[int]
    tried: tuple[int, ...] = (0,)
    figure: Literal["held-out", "shared"] = "held-out"
    starts: bool = False
    begun: Callable[[str], str] = from_dense
    over: str = LATER
    even: bool = False


_HIDDEN = "warp + hidden left out"
_WARPS = ("warp", "warp + no smoothness", _HIDDEN, f"{_HIDDEN} + no smoothness")
_RATES = ("means x4", "means x1/4", "means by pixels", "opacities x1/2", "scales x1/2", "colors x1/2")
_NAMED = ("rate 0.1", "random background", "rate 0.35", "flat")
_SHAPES = ("D-SSIM 0.4", "D-SSIM 0.4 + threshold 7e-4", "needles", "needles, weakly")
_SHORTER = (
    f"{DISTILLED[2]}, {HALF}", f"{DISTILLED[3]}, {THIRD}", f"distilled with {HALF}",
    f"distilled with means x1/4 + {HALF}, {_HIDDEN} + {HALF}",
)  # fmt: skip
_OVER_MEAN = (MEAN_BACKGROUND, f"random background + {MEAN_BACKGROUND}")
_BEGINNINGS = ("opaque", "small", "opaque + small", "large")
_WITHOUT = "without dropout", "without decay"
_SMOOTH = "smooth 0.1", "smooth 0.5", ELSEWHERE
_BESIDE = "early", PLANES, "absgrad", "D-SSIM 0.4", f"{_HIDDEN} + no smoothness"
_COUNTS = ("5,000 dense and few", "8,000 dense and few", "30,000 dense and few", "filled")
CHOICES = {
    "third": Choice(("rate 0.3", "no reset", "threshold 3e-4"), seeds=(0,)),
    "fourth": Choice((*_WARPS, "depth of the points"), seeds=range(FEWEST)),
    "fifth": Choice((_HIDDEN, f"{_HIDDEN} + every second step"), seeds=range(3, 6), figure="shared"),
    "sixth": Choice(_RATES, seeds=range(6)),
    "sixth, second round": Choice(_RATES, seeds=range(6), tried=(0, 1)),
    "seventh": Choice(_COUNTS, seeds=range(6), starts=True),
    "eighth": Choice(_NAMED, seeds=range(6)),
    "eighth, second round": Choice(_NAMED, seeds=range(6), tried=(0, 1)),
    "ninth": Choice(_SHAPES, seeds=range(6)),
    "ninth, second round": Choice(_SHAPES, seeds=range(6), tried=(0, 1)),
    "tenth": Choice((ONE_EXPOSURE,), seeds=range(6), tried=(0, 1, 2)),
    "eleventh": Choice((DISTILLED[2], DISTILLED[3], DISTILLED[1], TWICE), seeds=range(6), tried=(3,)),
    "twelfth": Choice((DISTILLED[2], *OTHER_KINDS), seeds=range(6), tried=(3,)),
    "thirteenth": Choice((HALF, THIRD, DISTILLED[2], OTHER_KINDS[-1], *_SHORTER), seeds=range(6), tried=(3,)),
    "seventeenth": Choice(("limit 0.2", "limit 0.1"), seeds=range(20)),
    "eighteenth": Choice(_OVER_MEAN, seeds=range(3), begun=from_today),
    "eighteenth, second round": Choice(_OVER_MEAN, seeds=range(3), tried=(0, 1, 2), begun=from_today),
    "nineteenth": Choice(_BEGINNINGS, seeds=range(3), figure="shared", begun=from_today),
    "nineteenth, second round": Choice(_BEGINNINGS, seeds=range(3), tried=(0, 1, 2), figure="shared", begun=from_today),
    "twentieth": Choice(("random background",), seeds=(3, 4, 5), tried=(3, 4, 5), begun=from_today),
    "twenty-third": Choice(
        (f"limit 0.2 + {MEAN_BACKGROUND}",), seeds=(2,), tried=(2,), begun=from_today, over=ANY_COLOR
    ),
    "twenty-fourth": Choice(_WITHOUT, seeds=(0,), begun=from_today, over=ANY_COLOR),
    "twenty-fifth": Choice((ONE_EXPOSURE,), seeds=range(6), tried=tuple(range(6)), begun=from_today, over=ANY_COLOR),
    "twenty-sixth": Choice(_SMOOTH, seeds=(0,), begun=from_today, over=ANY_COLOR),
    "twenty-sixth, by shared pixels": Choice(_SMOOTH, range(3), (0, 1, 2), "shared", begun=from_today, over=ANY_COLOR),
    "twenty-seventh": Choice((ONE_EXPOSURE,), range(6), tuple(range(6)), "shared", begun=from_today, over=TODAY),
    "twenty-eighth": Choice(_BESIDE, range(6), (0,), "shared", begun=from_today, over=TODAY, even=True),
    "twenty-eighth, two seeds": Choice(_BESIDE, range(6), (0, 1), "shared", begun=from_today, over=TODAY, even=True),
}
SLOWER_MEANS = {LATER: "recipe", f"{LATER} + means x1/4": "means x1/4"}
"""The judgement of the sixth choice, for `from_same_start`."""
SHARPER = {LATER: "recipe", f"{LATER} + {_SHAPES[1]}": _SHAPES[1]}
"""The judgement of the ninth choice, likewise."""
BESIDE_DROPOUT = {"dropout": "dropout alone", LATER: "recipe"}
"""The recipe beside dropout alone, from the start that a user has."""
DROPOUT_ALONE = {"plain": "plain", "dropout": "dropout alone"}
"""What the two lines of the README gain from there."""
BY_DEFAULT = {"plain": "plain", LATER: "recipe"}
"""What the recipe gained from the start that a user has: from the dense start as it was, and as it is now."""
BY_ANY_COLOR = {"plain": "plain", ANY_COLOR: "recipe"}
"""What it gained there up to the twenty-fifth choice."""
UNEVEN = ("herz-jesu", "sceaux")
"""The scenes whose photographs differ in exposure."""
EVEN = tuple(
    {name: title, f"{name} + {ONE_EXPOSURE}": f"{title}, {ONE_EXPOSURE}"}
    for name, title in ((ANY_COLOR, "recipe"), ("plain", "plain"), (f"{BINOCULAR}{RELATIVE}", BINOCULAR))
)
"""What the twenty-fifth choice adds to the recipe, to plain trainings and to Binocular3DGS's."""
EVEN_OVER_PLAIN = {"plain": "plain", f"{ANY_COLOR} + {ONE_EXPOSURE}": f"recipe, {ONE_EXPOSURE}"}
"""What the recipe would gain with it over plain trainings as they are."""

ENSEMBLE = {"plain": "plain", f"{LATER} + {DISTILLED[2]}": DISTILLED[2]}
"""The judgement of the eleventh choice: the seed is that of the first of two models."""
PLAIN_ENSEMBLE = {"plain": "plain", f"plain + {DISTILLED[2]}": f"plain, {DISTILLED[2]}"}
"""The same of plain trainings."""
_SLOW, *_, _WITH_BINOCULAR, _THREE_KINDS = OTHER_KINDS
KINDS = tuple({"plain": "plain", f"{LATER} + {name}": name} for name in (_SLOW, _THREE_KINDS, _WITH_BINOCULAR))
"""The judgement of the twelfth choice, of two models and of three, and what was not chosen."""
SHORTER = tuple({"plain": "plain", f"{LATER} + {name}": name} for name in _SHORTER[2:])
"""That of the thirteenth, of two models and of three."""
BESIDE_TWO = {f"{LATER} + {name}": name for name in (DISTILLED[2], _THREE_KINDS)}
"""Three kinds beside two seeds."""
BESIDE_BINOCULAR = tuple(
    {f"{BINOCULAR}{RELATIVE}": BINOCULAR, f"{LATER} + {name}": name}
    for name in (DISTILLED[2], _THREE_KINDS, _WITH_BINOCULAR, *_SHORTER[2:])
)
"""All these beside Binocular3DGS, from the start that a user has."""
SMOOTH = {ANY_COLOR: "before", TODAY: "smooth 0.1"}
"""The judgement of the twenty-sixth choice."""
SMOOTH_AND_EVEN = {TODAY: "smooth 0.1", f"{TODAY} + {ONE_EXPOSURE}": "and one exposure"}
"""That of the twenty-seventh."""
BY_TODAYS = {"plain": "plain", f"{TODAY} + {ONE_EXPOSURE}": "smooth 0.1, one exposure"}
"""What both gain over plain trainings as they are: what `ca-reg run` does today."""
BY_SMOOTH = {"plain": "plain", TODAY: "smooth 0.1"}
"""What the recipe gains alone."""
_TWO_MODELS = f"{TODAY} + {_SHORTER[2]} + {ONE_EXPOSURE}"
TWO_BY_TODAYS = {"plain": "plain", _TWO_MODELS: "two models"}
"""What two models of the same make gain."""
TWO_BESIDE_ONE = {f"{TODAY} + {ONE_EXPOSURE}": "one model", _TWO_MODELS: "two models"}
"""The same beside the first of them alone."""
SMOOTHLY = {_TWO_MODELS: "two models", _TWO_MODELS.replace(HALF, f"{HALF}, smoothly"): "smoothly"}
"""The judgement of the twenty-ninth choice."""
TODAYS_BESIDE_BINOCULAR = {f"{BINOCULAR}{RELATIVE}": BINOCULAR, f"{TODAY} + {ONE_EXPOSURE}": "recipe, one exposure"}
"""The recipe beside it, from the start as it is now."""
QUALITY = {
    f"{ANY_COLOR} + 5,000 steps": "one of 5,000",
    f"{LATER} + distilled with {HALF}": "two of 3,000",
    f"{LATER} + distilled with 2,500 steps": "two of 5,000",
    f"{ANY_COLOR} + D-SSIM 0.4 + 5,000 steps": "one of 5,000, sharper",
    f"{LATER} + threshold 3e-4 + random background + D-SSIM 0.4 + 5,000 steps": "one of 5,000, sharper and finer",
}
"""What the twenty-second choice trained for `ca-reg run --quality`, in rows of photographs as they are kept."""
WITHOUT = {"plain": "plain", ANY_COLOR: "recipe"} | {f"{ANY_COLOR} + {name}": name for name in _WITHOUT}
"""What the twenty-fourth leaves out, beside what it leaves it out of."""
LEFT_OUT = tuple({ANY_COLOR: "recipe", f"{ANY_COLOR} + {name}": name} for name in _WITHOUT)
"""The same, each held against the recipe."""
_UNITS = {
    "held-out": ("held-out", 1.0),
    "psnr": ("test psnr", 1.0),
    "lpips": ("test lpips", 1.0),
    "score": ("test ca_exact_half", 1e3),
    "thousands": ("gaussians", 1e-3),
    "seconds": ("seconds", 1.0),
}
"""What a template of `figures_of` may name: a figure of the rows, and what it is multiplied by."""
_JUDGED = (
    SLOWER_MEANS, SHARPER, ENSEMBLE, PLAIN_ENSEMBLE, *KINDS, *SHORTER, BESIDE_TWO, *BESIDE_BINOCULAR, BY_DEFAULT,
    BESIDE_DROPOUT, DROPOUT_ALONE,
)  # fmt: skip


def tables(rows: Sequence[Row]) -> list[str]:
    """Return all tables of the later choices; of rows of photographs as they are kept, that of `QUALITY`."""
    if any(row["candidate"] == next(iter(QUALITY)) for row in rows):
        return [figures_of(rows, QUALITY, "{held-out:.2f} / {psnr:.2f}, {lpips:.3f}, {thousands:.0f}, {seconds:.0f} s")]
    gained = [gains_of(rows, choice) for choice in CHOICES.values()]
    of_today = (
        BY_DEFAULT, BY_ANY_COLOR, TODAYS_BESIDE_BINOCULAR, *LEFT_OUT, *EVEN, EVEN_OVER_PLAIN, SMOOTH, SMOOTH_AND_EVEN,
        BY_SMOOTH, BY_TODAYS, TWO_BY_TODAYS, TWO_BESIDE_ONE, SMOOTHLY,
    )  # fmt: skip
    today = [from_same_start(rows, titles, from_today) for titles in of_today]
    without = figures_of(rows, WITHOUT, "{psnr:.2f}, {lpips:.3f}, {score:.2f}, {thousands:.0f}", (0,))
    return [*gained, *(from_same_start(rows, titles) for titles in _JUDGED), *today, without]


def figures_of(rows: Sequence[Row], titles: Mapping[str, str], template: str, seeds: Sequence[int] = range(20)) -> str:
    """Return a table of figures from today's start, by candidate and scene: means over the seeds, their number behind.

    Args:
        rows: all of them.
        titles: of the candidates, by the names of their rows.
        template: of a cell, with names of `_UNITS`.
        seeds: those that count.
    """
    named = {name: of for name, of in _UNITS.items() if f"{{{name}:" in template}
    lines = []
    for name, title in titles.items():
        lines.append({"candidate": title})
        for scene in SCENES:
            if of := [row for seed, row in _rows(rows, scene, name, from_today).items() if seed in seeds]:
                means = {x: unit * fmean(value(row, figure) for row in of) for x, (figure, unit) in named.items()}
                lines[-1][scene] = f"{template.format(**means)} ({len(of)})".replace("nan", "-")
    columns = ["candidate", *(scene for scene in SCENES if any(scene in line for line in lines))]
    return markdown_table([dict.fromkeys(columns, "-") | line for line in lines], columns)


def gains_of(rows: Sequence[Row], choice: Choice) -> str:
    """Return a table of what candidates gain with the dense start: at held-out / test views, and Gaussians."""
    lines, figure = [], choice.figure
    for name in choice.names:
        line, gains = {"candidate": name}, list[tuple[float, float]]()
        for scene in HELD_OUT:
            start = choice.begun(scene)
            over, end = name_on(scene, choice.over), f" + {ONE_EXPOSURE}" * (choice.even and scene in UNEVEN)
            own = (f"{scene}, {name}", over) if choice.starts else (start, f"{over} + {name}{end}")
            recipe, found = rows_of(rows, start, over + end), rows_of(rows, *own)
            before, after = (
                [(of[s][figure], value(of[s], "test psnr"), of[s]["gaussians"]) for s in who if figure in of.get(s, ())]
                for of, who in ((recipe, choice.seeds), (found, choice.tried))
            )
            if before and len(after) == len(choice.tried):
                usual, new = (tuple(map(fmean, zip(*of, strict=True))) for of in (before, after))
                gains.append((new[0] - usual[0], new[1] - usual[1]))
                line[scene] = "{:+.2f} / {:+.2f}, {:.2f}".format(*gains[-1], new[2] / usual[2])
        if gains:
            means = map(fmean, zip(*gains, strict=True))
            lines.append(line | {"mean": "{:+.2f} / {:+.2f}".format(*means), "scenes": str(len(gains))})
    columns = ["candidate", *(s for s in HELD_OUT if any(s in line for line in lines)), "mean", "scenes"]
    return markdown_table([dict.fromkeys(columns, "-") | line for line in lines], columns)


def name_on(scene: str, name: str) -> str:
    """Return the name of a setting's rows of a scene: some make no difference there.

    Where photographs show the background, it stays, and where they do not differ in exposure, they do.
    """
    name = name if scene in UNEVEN else name.removesuffix(f" + {ONE_EXPOSURE}")
    return name.replace(ANY_COLOR, LATER) if scene in SHOWN else name


def _rows(rows: Sequence[Row], scene: str, name: str, begun: Callable[[str], str]) -> dict[int, Row]:
    """Return the rows of a setting with a start, by seed."""
    if scene == "synthetic" and name == "plain":  # those of the paper's grid
        return references_of(rows, REFERENCES, scene)[name]
    start = scene if scene == "synthetic" else begun(scene)  # it has points of its own
    return rows_of(rows, start, name_on(scene, name))


def pairs_of(
    rows: Sequence[Row], names: Collection[str], begun: Callable[[str], str] = from_dense
) -> dict[str, list[tuple[float, float]]]:
    """Return test PSNR of two settings with the dense start, by scene, of the seeds that both have.

    ``begun`` names a scene with its start.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for scene in SCENES:
        if len({name_on(scene, name) for name in names}) == 1:
            continue
        before, after = (_rows(rows, scene, name, begun) for name in names)
        if shared := sorted(before.keys() & after.keys()):
            found[scene] = [(value(before[seed], "test psnr"), value(after[seed], "test psnr")) for seed in shared]
    return found


def from_same_start(rows: Sequence[Row], titles: Mapping[str, str], begun: Callable[[str], str] = from_dense) -> str:
    """Return a table of two settings with the dense start: test PSNR of the seeds that both have, and the gains.

    Args:
        rows: all of them.
        titles: of both, by the names of their rows.
        begun: names a scene with its start.
    """
    lines, every, means, spreads = [], list[float](), list[float](), list[float]()
    for scene, pairs in pairs_of(rows, titles.keys(), begun).items():
        figures = [*zip(*pairs, strict=True)]
        gains = [after - before for before, after in pairs]
        every += gains
        means.append(fmean(gains))
        spreads += [mean_std(figures[1])[1]] if len(pairs) > 1 else []
        line = {"scene": scene, "seeds": str(len(pairs))}
        line |= {title: format_mean_std(of, decimals=2) for title, of in zip(titles.values(), figures, strict=True)}
        lines.append(line | {"gain, by seed": ", ".join(f"{x:+.2f}" for x in gains)})
    if not lines:
        return "Nothing was trained with both."
    total = [
        f"- mean gain over {len(every)} pairs of {len(lines)} scenes: {fmean(every):+.2f} dB",
        f"- mean of the scenes' gains: {fmean(means):+.2f} dB",
        f"- worst pair: {min(every):+.2f} dB",
    ]
    if spreads:
        total.append(f"- standard deviation of seeds, mean over {len(spreads)} scenes: {fmean(spreads):.2f} dB")
    return "\n".join([markdown_table(lines, [*lines[0]]), "", *total])


if __name__ == "__main__":
    print(*tables(json.loads(Path(sys.argv[1]).read_text("utf-8"))), sep="\n\n")
