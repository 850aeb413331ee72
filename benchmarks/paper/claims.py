"""The claims of the paper and further comparisons as data: their trainings, tables and checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from benchmarks.paper.scenes import PAPER_SIZE, SCENES

__all__ = ["AT_PAPER_SIZE", "CLAIMS", "GAINS", "QUALITY", "TIMED", "Check", "Claim", "Setting", "chosen"]

Setting = Mapping[str, Any]
"""What a training changes relative to its recipe: fields of `TrainConfig`, ``recipe`` if it differs from the study's,
and ``views``. Steps in expressions refer to 10,000 iterations and are scaled to those of the study."""


@dataclass(frozen=True)
class Check:
    """A condition on the mean over seeds of paired differences: ``low < a - b < high``.

    Args:
        of: a figure of a row, such as "test psnr".
        a: the setting whose figure it is.
        b: the setting it is compared with.
        low: lower end of the claimed interval.
        high: upper end of the claimed interval.
        to: the figure of ``b``; by default the same.
        relative: whether the difference is divided by the figure of ``b``.
    """

    of: str
    a: Setting
    b: Setting
    low: float = -math.inf
    high: float = math.inf
    to: str = ""
    relative: bool = False


_PSNR, _CA = "test psnr", "test ca"
QUALITY = (_PSNR, "test ssim", "test lpips", _CA, "test ca_exact_half", "test depth_abs_rel", "test depth_rmse",
           "gaussians")  # fmt: skip
"""The columns of a table of models, as far as they were measured."""
TIMED = (*QUALITY, "seconds", "pace")
"""The same for models that were trained on one machine."""
_FEW = ("synthetic", "herz-jesu")
_STEADY = (*_FEW, "fern")  # whose seeds lie close together: three tell a fifth of a decibel
_WITH_MORE = ("synthetic", "fern")  # scenes with more than nine photographs to train on


@dataclass(frozen=True)
class Claim:
    """A claim, or a comparison without one.

    Args:
        says: the claim.
        paper: the paper's figures; CA in units of 1e-3.
        settings: the trainings, which are the rows of its table.
        checks: conditions that must all hold; none for a comparison.
        shows: the columns of its table.
        scenes: the declared scenes it is tested on; on a user's own scene every claim can be tested.
        needs: extra measurements: "path", "renders" or "depth".
    """

    says: str
    paper: str
    settings: tuple[Setting, ...]
    checks: tuple[Check, ...] = ()
    shows: tuple[str, ...] = QUALITY
    scenes: tuple[str, ...] = _FEW
    needs: frozenset[str] = frozenset()


def _with(regularizer: str = "", **changes: Any) -> Setting:
    return {"regularizer": regularizer} | changes if regularizer else changes


def _higher(of: str, a: Setting, b: Setting, to: str = "") -> Check:
    return Check(of, a, b, low=0, to=to)


def _lower(of: str, a: Setting, b: Setting, to: str = "") -> Check:
    return Check(of, a, b, high=0, to=to)


def _alike(of: str, a: Setting, b: Setting, within: float, to: str = "", *, relative: bool = False) -> Check:
    return Check(of, a, b, -within, within, to, relative)


def _with_recipe(recipe: str, claim: Claim, *scenes: str) -> Claim:
    """Return a claim about the trainings of another one, with another recipe."""
    of = {"recipe": recipe}
    settings = tuple({**of, **setting} for setting in claim.settings)
    checks = (replace(x, a={**of, **x.a}, b={**of, **x.b}) for x in claim.checks)
    name = {"binocular": "Binocular3DGS", "dngaussian": "DNGaussian"}[recipe]
    return replace(claim, says=f"with {name}: {claim.says}", settings=settings, checks=tuple(checks), scenes=scenes)


def _falling(of: str, settings: Sequence[Setting]) -> tuple[Check, ...]:
    return tuple(_lower(of, after, before) for before, after in pairwise(settings))


def _on(views: int, regularizer: str = "") -> Setting:
    """Return a training with a number of views; three are those of the scene and need no entry."""
    return _with(regularizer) if views == 3 else _with(regularizer, views=views)


def _three_ways(*recipes: str) -> tuple[Setting, ...]:
    """Return the trainings of recipes: each plain, with dropout and with noise."""
    return tuple({"recipe": name, **setting} for name in recipes for setting in _THREE)


_EVERY = tuple(SCENES)
_COURSE = tuple(
    f"{of} {sixth}"
    for of in ("path", "course ca/train", "course psnr/test", "course psnr/train")
    for sixth in range(1, 7)
)
_PLAIN = _with()
_DROPOUT = _with("dropout(0.2)")
_NOISE = _with("noise(0.8)")
_BOTH = _with("dropout(0.2) + noise(0.8)")
_THREE = (_PLAIN, _DROPOUT, _NOISE)
_EXPECTED = _with("dropout(0.2)", analytic=True)

# By number of views: with few the paper expects a gain, with many UGOD expects a loss.
_FEW_VIEWS, _MANY_VIEWS = (2, 3, 6, 9, 17), (24, 48)
_VIEWS = tuple(_on(n) for n in _FEW_VIEWS)
_VIEWS_SLIGHT = tuple(_on(n, "dropout(0.1)") for n in _FEW_VIEWS)
_VIEWS_DROPPED = tuple(_on(n, "dropout(0.2)") for n in _FEW_VIEWS)
_MANY = tuple(_on(n) for n in _MANY_VIEWS)
_MANY_SLIGHT = tuple(_on(n, "dropout(0.1)") for n in _MANY_VIEWS)
_MANY_DROPPED = tuple(_on(n, "dropout(0.2)") for n in _MANY_VIEWS)

# By strength; 0 is the plain training.
_RATE = {0.0: _PLAIN} | {p: _with(f"dropout({p})") for p in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)}
_SIGMA = {0.0: _PLAIN} | {s: _with(f"noise({s})") for s in (0.05, 0.2, 0.4, 0.6, 0.8, 1.0)}
_DEGREES = tuple(_with(sh_degree=degree) for degree in (0, 1, 2))

_SCALE_NOISE = _with("scale_noise(0.2)")
_POSITION_NOISE = _with("position_noise(0.1)")
_SH_NOISE = _with("sh_noise(0.1)")
_CONCRETE = _with("concrete")
_DENSITY = _with("density")
_GEOMETRY = _with("geometry")
_CLUSTERED = _with("clustered(0.2)")
_ANCHORS = _with("drop_anchors(ramp(0.0, 0.02, 0, 10_000))")
_TIERS = _with("d2gs(ramp(0.05, 0.3, 0, 10_000))")
_PROGRESSIVE = _with("drop_gaussian(0.2, 10_000)")
_GRADIENTS = _with("drop_gaussian(0.2, 10_000)", loss="straight_through('full')")
_ERRORS = _with("drop_gaussian(0.2, 10_000)", loss="straight_through('dropped')")
_TRIPLED = _with(loss="photometric + views(3)")
_BINOCULAR = _with(recipe="binocular")
_ABSOLUTE = _with(recipe="binocular", density="absgrad")
_LASTING = _with(recipe="binocular", opacity_decay=1.0)
_WITHOUT_ALPHA = tuple(
    {"recipe": "binocular", "loss": "photometric + warp(between(1.0, 6667))", **setting} for setting in _THREE
)

_SYSTEMS = _three_ways("3dgs", "dngaussian", "fsgs", "corgs", "binocular")
_FURTHER = _three_ways("mvgs", "absgs")
_ENSEMBLED = _three_ways("segs")
_SCHEMES = (
    *_THREE,
    _PROGRESSIVE,
    _DENSITY,
    _GEOMETRY,
    _with("soft(0.2)"),
    _CONCRETE,
    _ANCHORS,
    _CLUSTERED,
    _TIERS,
    _with("depth(ramp(0.05, 0.3, 0, 10_000))"),
    _SCALE_NOISE,
    _POSITION_NOISE,
    _SH_NOISE,
    _with("segs(0.08, 0.02, 2_000, 9_500)"),
    _with("drop_sh(until=(2_000, 4_000, 6_000))"),
    _with(loss="photometric + consistency(0.4, 0.2)"),
    _with(opacity_decay=0.999),
)

CLAIMS = {
    "1": Claim("dropout of 0.2 lowers CA and raises the PSNR of new views",
               "LLFF: CA 8.21 -> 2.34, 19.36 -> 20.20 dB; Blender: 23.54 -> 24.14 dB", (_PLAIN, _DROPOUT),
               (_lower(_CA, _DROPOUT, _PLAIN), _higher(_PSNR, _DROPOUT, _PLAIN)), scenes=_EVERY),
    "2": Claim("so does opacity noise of 0.8", "LLFF: CA 8.21 -> 2.30, 19.36 -> 19.91 dB; Blender: 23.54 -> 23.65 dB",
               (_PLAIN, _NOISE), (_lower(_CA, _NOISE, _PLAIN), _higher(_PSNR, _NOISE, _PLAIN)), scenes=_EVERY),
    "3": Claim("both together bring less than 0.1 dB over dropout alone", "Binocular3DGS: 22.12, 22.12 and 22.11 dB",
               (_DROPOUT, _NOISE, _BOTH), (Check(_PSNR, _BOTH, _DROPOUT, high=0.1),), scenes=_EVERY),
    "4": Claim("CA falls as the training views increase", "DNGaussian, Binocular3DGS: a figure (flower)",
               (*_VIEWS, *_VIEWS_DROPPED), _falling(_CA, _VIEWS), scenes=_WITH_MORE),
    "5": Claim("CA drops early in the training, from 1/6 to 2/6 of the steps, then settles: to 20 % after 4/6",
               "DNGaussian, Binocular3DGS: a figure (flower, orchids)", _THREE,
               (_lower("path 2", _PLAIN, _PLAIN, "path 1"),
                _alike("path 6", _PLAIN, _PLAIN, 0.2, "path 4", relative=True)),
               tuple(f"path {sixth}" for sixth in range(1, 7)), _EVERY, frozenset({"path"})),
    "6": Claim("CA is lower at training views than at new ones",
               "all rows of LLFF and DTU: 7.54 < 8.21, 1.75 < 2.34; not plain 3DGS on Blender: 4.25 > 3.94",
               _THREE, tuple(_lower("train ca", each, each, _CA) for each in _THREE),
               ("train ca", _CA, "train ca_exact_half", "test ca_exact_half"), _EVERY),
    "7": Claim("the dropout rate 0.2 is best, no other 0.1 dB above it, and 0.3 to 0.5 less than 0.3 dB below",
               "Binocular3DGS: 21.44, 21.90, 22.12, 22.04, 22.03, 21.93, 21.79 dB for 0 to 0.6", tuple(_RATE.values()),
               (_higher(_PSNR, _DROPOUT, _PLAIN), *(Check(_PSNR, _RATE[p], _DROPOUT, high=0.1) for p in (0.1, 0.6)),
                *(Check(_PSNR, _RATE[p], _DROPOUT, -0.3, 0.1) for p in (0.3, 0.4, 0.5))), scenes=_STEADY),
    "8": Claim("noise of 0.8 helps, 0.4 to 1.0 are alike to 0.2 dB, and CA falls with its scale",
               "Binocular3DGS: 21.44 dB without, 22.07, 22.00, 22.12, 22.05 dB at 0.4, 0.6, 0.8, 1.0; CA 1.95 -> 0.64",
               tuple(_SIGMA.values()),
               (_higher(_PSNR, _NOISE, _PLAIN), *(_alike(_PSNR, _SIGMA[s], _NOISE, 0.2) for s in (0.4, 0.6, 1.0)),
                *_falling(_CA, [*_SIGMA.values()])), scenes=_STEADY),
    "9": Claim("after dropout a render with scaled opacities (C) and the mean of five dropout renders (B) are alike to "
               "0.1 dB, and better than one dropout render (A)", "Binocular3DGS: 21.98 (A), 22.12 (B), 22.12 dB (C)",
               (_DROPOUT,),
               (*(_higher(of, _DROPOUT, _DROPOUT, "renders one") for of in ("renders five", _PSNR)),
                _alike(_PSNR, _DROPOUT, _DROPOUT, 0.1, "renders five")),
               ("renders one", "renders five", _PSNR, "renders mean"), _EVERY, frozenset({"renders"})),
    "10": Claim("noise of 0.2 on scales helps, of 0.1 on positions harms, of 0.1 on colors does nothing (0.1 dB)",
                "Binocular3DGS: 21.44 dB without; 21.76, 21.09, 21.48 dB",
                (_PLAIN, _SCALE_NOISE, _POSITION_NOISE, _SH_NOISE),
                (_higher(_PSNR, _SCALE_NOISE, _PLAIN), _lower(_PSNR, _POSITION_NOISE, _PLAIN),
                 _alike(_PSNR, _SH_NOISE, _PLAIN, 0.1)), scenes=_STEADY),
    "11": Claim("the degree of the spherical harmonics matters less than 0.2 dB",
                "19.29, 19.24, 19.38, 19.36 dB for 0 to 3",
                (*_DEGREES, _PLAIN), tuple(_alike(_PSNR, each, _PLAIN, 0.2) for each in _DEGREES),
                scenes=_STEADY),
    "12": Claim("the number of Gaussians stays comparable, to a quarter", "111k, 115k with dropout, 98k with noise",
                _THREE, tuple(_alike("gaussians", each, _PLAIN, 0.25, relative=True) for each in (_DROPOUT, _NOISE)),
                ("gaussians",), _EVERY),
    "13": Claim("the variance of color along a ray, CV, falls",
                "Binocular3DGS: 0.256 -> 0.107 with dropout, 0.053 with noise", _THREE,
                tuple(_lower("test cv", each, _PLAIN) for each in (_DROPOUT, _NOISE)), ("test cv", "train cv"), _EVERY),
    "14": Claim("depth becomes better (AbsRel)", "DNGaussian: 0.0732 -> 0.0676 with dropout, 0.0651 with noise", _THREE,
                tuple(_lower("depth abs_rel", each, _PLAIN) for each in (_DROPOUT, _NOISE)),
                ("depth abs_rel", "depth rmse", "depth mae", "depth log10"),
                tuple(name for name in SCENES if name != "lego"), frozenset({"depth"})),  # it has no other photographs
    "15": Claim("concrete dropout is worse than none, dropout by density as good as uniform one, to 0.15 dB",
                "Binocular3DGS: 21.44 dB without, 20.88; 22.05 against 22.12 dB",
                (_PLAIN, _DROPOUT, _CONCRETE, _DENSITY, _GEOMETRY),
                (_lower(_PSNR, _CONCRETE, _PLAIN), _alike(_PSNR, _DENSITY, _DROPOUT, 0.15)),
                scenes=_STEADY),
    "16": Claim("steps of three views raise CA and the number of Gaussians",
                "10,000 steps: CA 8.2 -> 24.3, 111k -> 1,144k; 259k after 3,000",
                (_PLAIN, _TRIPLED), tuple(_higher(of, _TRIPLED, _PLAIN) for of in (_CA, "gaussians")), scenes=_STEADY),
    "17": Claim("absolute gradients lower the CA of Binocular3DGS; without its opacity decay it rises",
                "1.95 -> 1.59; 4.83", (_BINOCULAR, _ABSOLUTE, _LASTING),
                (_lower(_CA, _ABSOLUTE, _BINOCULAR), _higher(_CA, _LASTING, _BINOCULAR))),
    "late": Claim("from 2/6 of the steps on CA rises again, with dropout or noise by less than a tenth",
                  "Binocular3DGS: a figure (flower, orchids)", _THREE,
                  (_higher("path 6", _PLAIN, _PLAIN, "path 2"),
                   *(Check("path 6", each, each, high=0.1, to="path 2", relative=True) for each in (_DROPOUT, _NOISE))),
                  _COURSE, _EVERY, frozenset({"path"})),
    "onset": Claim("the CA of Binocular3DGS rises when its warp loss sets in, at 4/6 of the steps, and with dropout or "
                   "noise by less than a tenth", "a figure (flower, orchids): at 20,000 of 30,000 steps",
                   _three_ways("binocular"),
                   (_higher("path 5", _BINOCULAR, _BINOCULAR, "path 4"),
                    *(Check("path 5", {**_BINOCULAR, **each}, {**_BINOCULAR, **each}, high=0.1, to="path 4",
                            relative=True) for each in (_DROPOUT, _NOISE))),
                   _COURSE, ("fern",), frozenset({"path"})),
    "exact": Claim("the exact score beside the paper's protocol", "", _THREE,
                   shows=(_CA, "test ca_exact", "test ca_exact_half", "train ca", "train ca_exact"), scenes=_EVERY),
    "scaled": Claim("after noise, too, opacities scaled by their mean factor are better than plain ones", "", (_NOISE,),
                    (Check("renders scaled", _NOISE, _NOISE, low=0, to=_PSNR),),
                    (_PSNR, "renders scaled", "renders five", "renders mean"), (*_FEW, "lego", "fountain"),
                    frozenset({"renders"})),
    "analytic": Claim("trained on the expectation over all masks dropout is as good as on draws, to 0.15 dB", "",
                      (_DROPOUT, _EXPECTED), (_alike(_PSNR, _EXPECTED, _DROPOUT, 0.15),),
                      scenes=_STEADY),
    "systems": Claim("five systems, each plain, with dropout and with noise", "the main table", _SYSTEMS,
                     shows=TIMED, scenes=("synthetic", "fern", "herz-jesu")),
    "further": Claim("further systems, likewise", "", _FURTHER, shows=TIMED, scenes=("synthetic", "fern")),
    "ensembled": Claim("SE-GS, likewise", "", _ENSEMBLED, shows=TIMED, scenes=("synthetic", "fern")),
    "schemes": Claim("no scheme of the field is 0.1 dB better than uniform dropout of 0.2", "", _SCHEMES,
                     tuple(Check(_PSNR, each, _DROPOUT, high=0.1) for each in _SCHEMES[3:]), TIMED, _STEADY),
    "views": Claim("dropout of 0.2 helps with 2 to 17 views", "", (*_VIEWS, *_VIEWS_DROPPED),
                   tuple(_higher(_PSNR, *pair) for pair in zip(_VIEWS_DROPPED, _VIEWS, strict=True)),
                   scenes=_WITH_MORE),
    "many-views": Claim("dropout of 0.2 harms with 24 views and more (UGOD)", "",
                        (*_MANY, *_MANY_DROPPED),
                        tuple(_lower(_PSNR, *pair) for pair in zip(_MANY_DROPPED, _MANY, strict=True)),
                        scenes=("synthetic",)),
    "slight": Claim("with six to 17 views a rate of 0.1 is better than one of 0.2", "",
                    (*_VIEWS_SLIGHT, *_VIEWS_DROPPED),
                    tuple(_higher(_PSNR, *pair) for pair in zip(_VIEWS_SLIGHT[2:], _VIEWS_DROPPED[2:], strict=True)),
                    scenes=_WITH_MORE),
    "slight-many": Claim("with 24 views and more a rate of 0.1 is better than one of 0.2", "",
                         (*_MANY_SLIGHT, *_MANY_DROPPED),
                         tuple(_higher(_PSNR, *pair) for pair in zip(_MANY_SLIGHT, _MANY_DROPPED, strict=True)),
                         scenes=("synthetic",)),
    "neighbors": Claim("dropping neighbors together is better (DropAnSH-GS: they compensate)", "",
                       (_DROPOUT, _CLUSTERED, _ANCHORS), (_higher(_PSNR, _CLUSTERED, _DROPOUT),), scenes=_STEADY),
    "guided": Claim("rates by depth and density are better than one for all (D2GS)", "", (_DROPOUT, _TIERS),
                    (_higher(_PSNR, _TIERS, _DROPOUT),), scenes=_STEADY),
    "size": Claim("both remedies lower CA and raise the PSNR of new views, with pictures of the paper's size",
                  "10,000 steps: LLFF 19.36 -> 20.20 (dropout), 19.91 dB (noise), CA 8.21 -> 2.34, 2.30",
                  (*_THREE, _SIGMA[0.4]),  # the paper tunes the noise of each system, from 0.05 to 0.8
                  tuple(check for each in (_DROPOUT, _NOISE)
                        for check in (_lower(_CA, each, _PLAIN), _higher(_PSNR, each, _PLAIN))),
                  (*TIMED, "train ca", "test cv"), scenes=tuple(PAPER_SIZE)),
    "hidden": Claim("the gain comes from the gradients of hidden Gaussians (DropGaussian's authors): it stays, to 0.3 "
                    "dB, with the error of the full render", "",
                    (_PLAIN, _PROGRESSIVE, _GRADIENTS, _ERRORS),
                    (_higher(_PSNR, _GRADIENTS, _PLAIN), _alike(_PSNR, _GRADIENTS, _PROGRESSIVE, 0.3)), TIMED),
}  # fmt: skip
_TRUE_DEPTH = replace(  # of evaluations, which know it of a scene that has it
    CLAIMS["14"],
    checks=tuple(_lower("test depth_abs_rel", each, _PLAIN) for each in (_DROPOUT, _NOISE)),
    shows=("test depth_abs_rel", "test depth_rmse"),
    needs=frozenset(),
)
CLAIMS |= {
    "3-binocular": _with_recipe("binocular", CLAIMS["3"], "synthetic"),
    "7-binocular": _with_recipe("binocular", CLAIMS["7"], "synthetic"),
    "8-binocular": _with_recipe("binocular", CLAIMS["8"], "synthetic"),
    "9-binocular": _with_recipe("binocular", CLAIMS["9"], "synthetic"),
    "10-binocular": _with_recipe("binocular", CLAIMS["10"], "synthetic"),
    "13-binocular": _with_recipe("binocular", CLAIMS["13"], "synthetic", "fern", "herz-jesu"),
    "14-binocular": _with_recipe("binocular", _TRUE_DEPTH, "synthetic"),
    "14-dngaussian": _with_recipe("dngaussian", _TRUE_DEPTH, "synthetic"),
    "15-binocular": _with_recipe("binocular", CLAIMS["15"], "synthetic"),
    "size-binocular": _with_recipe("binocular", CLAIMS["size"], *PAPER_SIZE),
    "size-late": replace(CLAIMS["late"], scenes=tuple(PAPER_SIZE)),
    "size-onset": replace(CLAIMS["onset"], scenes=tuple(PAPER_SIZE)),
    "size-alpha": Claim(
        "without its alpha term Binocular3DGS loses PSNR on photographs with an alpha channel", "",
        (*_three_ways("binocular"), *_WITHOUT_ALPHA),
        tuple(_lower(_PSNR, *pair) for pair in zip(_WITHOUT_ALPHA, _three_ways("binocular"), strict=True)),
        (_PSNR, _CA, *(f"{of} {sixth}" for of in ("path", "course psnr/test") for sixth in (4, 5))),
        ("lego-400",), frozenset({"path"}),
    ),
}  # fmt: skip
"""The seventeen claims by their number, then further questions of the field by name."""

AT_PAPER_SIZE = ("size", "size-binocular", "size-late", "size-onset", "size-alpha")
"""Those that have a page of their own."""

GAINS: Mapping[str, Mapping[str, Mapping[float, tuple[Setting, Setting]]]] = {
    "dropout rate": {"": {p: (each, _PLAIN) for p, each in _RATE.items()}},
    "scale of opacity noise": {"": {s: (each, _PLAIN) for s, each in _SIGMA.items()}},
    "training views": {
        "dropout 0.2": {n: (_on(n, "dropout(0.2)"), _on(n)) for n in (*_FEW_VIEWS, *_MANY_VIEWS)},
        "dropout 0.1": {n: (_on(n, "dropout(0.1)"), _on(n)) for n in (*_FEW_VIEWS, *_MANY_VIEWS)},
    },
}
"""The axes of the figure: for every line, by name, a pair of settings to compare at each position on the axis."""


def chosen(names: Sequence[str], scenes: Sequence[str] | None = None) -> dict[str, Claim]:
    """Return the named claims, or all if none is named; with ``scenes`` they are tested on these instead of their own.

    Raises ValueError if there is no such claim.
    """
    if unknown := [name for name in names if name not in CLAIMS]:
        raise ValueError(f"there is no claim {unknown[0]}; choose of {', '.join(CLAIMS)}.")
    found = {name: CLAIMS[name] for name in names or CLAIMS}
    return found if scenes is None else {name: replace(it, scenes=tuple(scenes)) for name, it in found.items()}
