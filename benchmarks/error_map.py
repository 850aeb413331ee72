"""How well an error map knows the error: leave one scene out, against its rivals, on the same models.

    python -m benchmarks.error_map SCENE-SETTING-SEED=RUN ... [--keep FOLDER] [--rivals] [--weights] [--rows FILE]
    python -m benchmarks.error_map --rows benchmarks/data/error_map.json
    python -m benchmarks.error_map NAME=RUN ... --picture docs/images/error_map.webp

RUN is the folder of a finished training; RUN,RUN,... that of the model and those of other seeds, whose spread is a
rival. Prints figures of every model and writes them as JSON to ``--rows``; without a RUN, prints what was written as
the tables of ``benchmarks/error_map.md``, which has the protocol.
``--weights`` prints those of `ca_reg.error_maps.FORMS`, fitted on all scenes. What is measured of a model is kept in
the folder, and not measured again.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.stats import spearmanr
from torch import Tensor

from benchmarks.error_map_tables import scene_of, setting_of, tables
from ca_reg import error_maps as form_of
from ca_reg.functional import Multiplier
from reference_trainer.evaluation.error_maps import ErrorMaps
from reference_trainer.evaluation.evaluate import error_picture, expected_error_picture
from reference_trainer.evaluation.metrics import ssim
from reference_trainer.evaluation.pictures import heat_map
from reference_trainer.evaluation.style import WIDTH, new_figure, readable
from reference_trainer.evaluation.trained_model import MaskedRenders, TrainedModel
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render.renderer import render_moments
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.scene import Scene, View

VIEWS = 8
STEPS = 100
PIXELS = 4000
"""Of each view that a fit sees, drawn at random."""
FLOOR = 0.3
"""Of the mean error: keeps pixels that are expected to be right from ruling the fit."""
RATES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)


class Seen(NamedTuple):
    """One view of a model: the terms of the forms, the rivals, and the error, (P,) each, of the pixels that count.

    ``own`` has the means of the terms over the training views, each without its own photograph, and under "difference"
    what these photographs differ by, where another one can be brought.
    """

    terms: dict[str, np.ndarray]
    rivals: dict[str, np.ndarray]
    error: np.ndarray
    squared: np.ndarray
    own: dict[str, float]


def left(order: np.ndarray, error: np.ndarray, *, root: bool = False) -> np.ndarray:
    """Return the mean error, or its root mean square, of what is left when 0, 1, ... 99 % of the pixels are removed.

    The first of an order are removed first. Relative to all.
    """
    e = (error[order] ** 2 if root else error[order])[::-1]
    rest = (np.cumsum(e) / np.arange(1, len(e) + 1))[::-1]
    curve = rest[np.arange(STEPS) * len(e) // STEPS]
    return np.asarray(np.sqrt(curve / curve[0]) if root else curve / curve[0])


def ause(predicted: np.ndarray, error: np.ndarray, *, root: bool = False) -> float:
    """Return the area between the sparsification curves of a prediction and of the error itself; ties at random."""
    ties = np.random.default_rng(0).random(len(error))
    found = left(np.lexsort((ties, -predicted)), error, root=root) - left(np.argsort(-error), error, root=root)
    return float(found.mean())


def rate_of_ph_dropout(model: TrainedModel, train: Sequence[View]) -> float:
    """Return the largest rate at which the mean SSIM on the training views falls by at most 5 %, of five masks each."""

    def quality(rate: float) -> float:
        generator, n = torch.Generator().manual_seed(0), len(model.gaussians)
        renders = MaskedRenders(model)
        values = []
        for view in train:
            keep = (torch.rand(5, n, generator=generator) >= rate).float() if rate else torch.ones(1, n)
            images, _ = renders.render_batch(model.gaussians.opacities * keep, view)
            values += [ssim(image.clamp(0, 1), view.image) for image in images]
        return float(np.mean(values))

    best = quality(0.0)
    return max((rate for rate in RATES if quality(rate) >= 0.95 * best), default=RATES[0])


def sampled(model: TrainedModel, view: View, samples: int, rate: float) -> Tensor:
    """Return the standard deviation of K masked renders, root of the mean over RGB, (H, W)."""
    generator, renders = torch.Generator().manual_seed(1), MaskedRenders(model)
    images = []
    for _ in range(0, samples, 5):
        keep = (torch.rand(5, len(model.gaussians), generator=generator) >= rate).float()
        images.append(renders.render_batch(model.gaussians.opacities * keep, view)[0])
    return torch.cat(images).double().var(0).mean(0).sqrt()


class Fisher:
    """A diagonal Fisher information of all parameters from the training views, and the pixels' deviation by it.

    The diagonal is estimated with random signs, four a photograph, damped by a thousandth of its mean over each kind of
    parameter; the pixels' variance by 16 central differences along random directions of the inverse's root.
    """

    def __init__(self, model: TrainedModel, train: Sequence[View]) -> None:
        self.model = model
        fields = {f.name: getattr(model.gaussians, f.name) for f in dataclasses.fields(model.gaussians)}
        self.raw = {name: x.detach() for name, x in fields.items() if isinstance(x, Tensor) and x.is_floating_point()}
        total = {name: torch.zeros_like(x) for name, x in self.raw.items()}
        generator = torch.Generator().manual_seed(2)
        for view in train:
            for _ in range(4):
                leaves = {name: x.clone().requires_grad_() for name, x in self.raw.items()}
                image = self._render(leaves, view)
                signs = torch.randint(0, 2, image.shape, generator=generator) * 2.0 - 1
                found = torch.autograd.grad((image * signs).sum(), [*leaves.values()], allow_unused=True)
                for name, g in zip(leaves, found, strict=True):
                    total[name] += 0.0 if g is None else g.square() / 4
        self.root = {name: (h + 1e-3 * h.mean() + 1e-12).rsqrt() for name, h in total.items()}

    def _render(self, raw: Mapping[str, Tensor], view: View) -> Tensor:
        gaussians = dataclasses.replace(self.model.gaussians, **raw)
        return render_gaussians(gaussians, view.camera, self.model.background, sh_degree=self.model.sh_degree).image

    @torch.no_grad()
    def __call__(self, view: View) -> Tensor:
        generator, step, total = torch.Generator().manual_seed(3), 0.01, torch.zeros(())
        for _ in range(16):
            along = {n: step * r * torch.randn(r.shape, generator=generator) for n, r in self.root.items()}
            ends = [self._render({n: self.raw[n] + sign * d for n, d in along.items()}, view) for sign in (1, -1)]
            total = total + ((ends[0] - ends[1]) / (2 * step)).square().mean(0) / 16
        return total.sqrt()


def look(
    model: TrainedModel, scene: Scene, ensemble: Sequence[TrainedModel] = (), *, rivals: bool
) -> tuple[list[Seen], dict[str, float]]:
    """Measure a model at its test views; return also seconds of the processor, per view where a view is measured."""
    views = scene.test[:: max(1, -(-len(scene.test) // VIEWS))]
    spent: dict[str, float] = {}

    def timed(name: str, call: Callable[[], Any]) -> Any:
        start = time.process_time()
        found = call()
        spent[name] = spent.get(name, 0.0) + (time.process_time() - start) / len(views)
        return found

    maps = timed("once a model", lambda: ErrorMaps(model, scene.train))
    sums: dict[str, float] = {}
    for number in range(len(scene.train)):
        difference, features = maps.left_out(number)
        for name, x in {**with_products(features), "difference": difference}.items():
            sums[name] = sums.get(name, 0.0) + x[features["hidden"] == 0].sum().item()
    own = {name: x / sums["constant"] for name, x in sums.items()}
    fisher = Fisher(model, scene.train) if rivals else None
    rate = model.dropout or form_of.PLAIN_RATE
    rule = rate_of_ph_dropout(model, scene.train) if rivals else rate
    spent["PH-Dropout's rate"] = rule * 1.0
    seen = []
    for number, view in enumerate(views):
        out = timed("a render", lambda view=view: model.test_rendering(view))
        features = timed("error map", lambda view=view: maps.features(view))
        terms = with_products(features)
        keep = torch.ones_like(out.alpha, dtype=torch.bool)
        if view.mask is not None:
            keep = view.mask > 254.5 / 255
        elif view.alpha is not None:
            keep = (view.alpha > 0.5) | (out.alpha > 0.5)
        others = {
            "deviation": features["deviation"], "colors": features["colors"], "gradient": features["contrast"],
            "1 - alpha": features["empty"],
            "random": torch.rand(out.alpha.shape, generator=torch.Generator().manual_seed(number)),
        }  # fmt: skip
        images = torch.stack([out.image, *(other.test_rendering(view).image for other in ensemble)]).clamp(0, 1)
        for count in (3, 5):
            if count <= len(images):
                others[f"ensemble of {count}"] = images[:count].double().var(0).mean(0).sqrt()
        if fisher is not None:
            with torch.no_grad():
                splats = model.splats(model.gaussians.opacities, view)
                moments = render_moments(splats, Multiplier.dropout(rule), background=model.background)
                others["PH-Dropout's rate"] = moments.variance.mean(0).sqrt()
                for count in (5, 100):
                    others[f"{count} masks"] = timed(
                        f"{count} masks", lambda c=count, v=view: sampled(model, v, c, rate)
                    )
            others["Fisher"] = timed("Fisher", lambda view=view: fisher(view))
        off = out.image.clamp(0, 1) - view.image
        smooth = {name: form_of.smoothed(x)[keep].numpy().astype(np.float32) for name, x in terms.items()}
        flat = {name: x[keep].double().numpy().astype(np.float32) for name, x in others.items()}
        seen.append(
            Seen(
                smooth, flat, off.abs().mean(0)[keep].double().numpy(), off.square().mean(0)[keep].double().numpy(), own
            )
        )
    return seen, spent


def with_products(features: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return all terms of all forms."""
    products = {
        "constant": torch.ones_like(features["empty"]),
        "hidden*colors": features["hidden"] * features["colors"],
    }
    return {**features, **products}


def unit(view: Seen, weights: Mapping[str, float]) -> float:
    """Return the unit that the model's own photographs give; 1 for a form without them."""
    return view.own["difference"] / sum(w * view.own[t] for t, w in weights.items()) if "warp" in weights else 1.0


class Fitted(NamedTuple):
    """Weights in units of color; what the unit of a model is times; squares; spread of the PSNR, dB."""

    weights: dict[str, float]
    transfer: float
    peaked: float
    spread: float

    def expect(self, view: Seen) -> np.ndarray:
        """Return the expected error of a view's pixels."""
        factor = self.transfer * unit(view, self.weights) if "warp" in self.weights else 1.0
        return factor * predict(view, self.weights)


def fitted(views: Sequence[Seen], terms: Sequence[str]) -> Fitted:
    """Fit the shape to errors relative to their view's mean, every view counting alike; then the units."""
    rng = np.random.default_rng(0)
    picks = [rng.permutation(len(v.error))[:PIXELS] for v in views]
    x = np.concatenate([np.stack([v.terms[t][p] for t in terms], 1) for v, p in zip(views, picks, strict=True)]).astype(
        float
    )
    y = np.concatenate([v.error[p] / v.error.mean() for v, p in zip(views, picks, strict=True)])
    each = np.concatenate([np.full(len(p), 1 / len(p)) for p in picks])
    expected = np.ones(len(y))
    for _ in range(6):  # the error of a pixel grows with its expectation
        w = each / (expected + FLOOR) ** 2
        gram, right = (x * w[:, None]).T @ x, (x * w[:, None]).T @ y
        root = np.linalg.cholesky(gram + 1e-12 * np.trace(gram) * np.eye(len(terms)))
        weights = nnls(root.T, np.linalg.solve(root, right))[0]
        expected = x @ weights
    found = dict(zip(terms, weights.tolist(), strict=True))
    own = np.array([unit(v, found) for v in views])
    of_scene = np.array([v.own["difference"] for v in views])  # one number a model: views of a scene count together
    counts = np.array([1 / np.sum(of_scene == d) for d in of_scene])
    logs = np.array([math.log(v.error.mean() / predict(v, found).mean()) for v in views])
    size = math.exp(np.average(logs, weights=counts))
    transfer = math.exp(np.average(logs - np.log(own), weights=counts))
    found = {t: size * w for t, w in found.items()}
    factors = [transfer * unit(v, found) if "warp" in found else 1.0 for v in views]
    ratios = [
        math.log10(v.squared.mean() / ((f * predict(v, found)) ** 2).mean())
        for f, v in zip(factors, views, strict=True)
    ]
    return Fitted(found, transfer, 10 ** float(np.average(ratios, weights=counts)), 10 * float(np.std(ratios, ddof=1)))


def predict(view: Seen, weights: Mapping[str, float]) -> np.ndarray:
    """Return the expected error of a view's pixels."""
    return np.asarray(sum(w * view.terms[t] for t, w in weights.items() if w)) + 0.0 * view.error


def held_out(models: Mapping[str, list[Seen]], terms: Sequence[str], *, kinds: bool = False) -> dict[str, Any]:
    """Fit for every scene on the others; with ``kinds``, models with and without dropout apart."""
    plain = {name: setting_of(name) in ("plain", "binocular") for name in models}
    known: dict[Any, Any] = {}
    for name in models:
        key = scene_of(name), plain[name] if kinds else None
        if key not in known:
            others = {m: v for m, v in models.items() if scene_of(m) != key[0] and key[1] in (None, plain[m])}
            scenes = {scene_of(m) for m in others}
            # A scene counts once, however many models it has.
            picked = [
                v for s in sorted(scenes) for v in [w for m, of in others.items() if scene_of(m) == s for w in of]
            ]
            known[key] = fitted(picked, terms)
    return {name: known[scene_of(name), plain[name] if kinds else None] for name in models}


def figure_of(
    models: Mapping[str, list[Seen]], of: Callable[[str, Seen], np.ndarray], score: Callable[..., float]
) -> list[float]:
    """Return a figure of every model, mean over its views; nan where the prediction is not known."""

    def mean(name: str, views: Sequence[Seen]) -> float:
        with contextlib.suppress(KeyError):
            return float(np.mean([score(of(name, v), v.error) for v in views]))
        return math.nan

    return [mean(name, views) for name, views in models.items()]


class Quality(NamedTuple):
    """Of one view: mean absolute error and PSNR, measured and expected."""

    error: float
    expected_error: float
    psnr: float
    expected_psnr: float

    @classmethod
    def of(cls, view: Seen, by: Fitted) -> Quality:
        """Measure a view."""
        found = by.expect(view)
        psnr, expected = (-10 * math.log10(x) for x in (view.squared.mean(), by.peaked * (found**2).mean()))
        return cls(float(view.error.mean()), float(found.mean()), psnr, expected)


def ranked(views: Mapping[str, Sequence[Quality]], first: str, second: str) -> dict[str, tuple[float, float]]:
    """Return by how many dB models of a second setting are better than those of a first: measured, and as expected.

    By scene and seed, where both exist; mean over the views.
    """
    found = {}
    for name, own in views.items():
        if setting_of(name) == first and (other := views.get(f"{scene_of(name)}-{second}-{name.rsplit('-', 1)[1]}")):
            both = [np.mean([getattr(v, f) for v in other]) - np.mean([getattr(v, f) for v in own])
                    for f in ("psnr", "expected_psnr")]  # fmt: skip
            found[f"{scene_of(name)}, seed {name.rsplit('-', 1)[1]}"] = (float(both[0]), float(both[1]))
    return found


def plot(runs: Mapping[str, str], file: Path) -> None:
    """Plot the last test view of every run: render, measured error, expected error, and what no photograph shows."""
    with new_figure(file) as figure:
        figure.set_size_inches(WIDTH, 1.75 * len(runs) + 0.3)
        axes = figure.subplots(len(runs), 4, squeeze=False)
        for of_run, (name, run) in zip(axes, runs.items(), strict=True):
            model, scene = load_run_model(Path(run))
            view, maps = scene.test[-1], ErrorMaps(model, scene.train)
            found, image = maps(view), model.test_rendering(view).image.clamp(0, 1)
            error = (image - view.image).abs().mean(0)
            hidden = heat_map(maps.features(view)["hidden"], 1.0)
            pictures = {
                f"{readable(name)}: render": image,
                f"measured, mean {error.mean():.3f}": error_picture(image, view.image),
                f"expected, {found.error.mean():.3f}": expected_error_picture(found), "seen by no photograph": hidden,
            }  # fmt: skip
            for ax, (title, picture) in zip(of_run, pictures.items(), strict=True):
                ax.imshow((picture.permute(1, 2, 0) * 255).round().byte().numpy())
                ax.set_title(title, fontsize=10, fontweight="normal")
                ax.set_axis_off()


def main() -> None:
    """Measure, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="*")
    parser.add_argument("--keep", type=Path, default=Path("error_map"))
    parser.add_argument("--rivals", action="store_true")
    parser.add_argument("--weights", action="store_true")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    if options.picture:
        plot(dict(each.split("=", 1) for each in options.runs), options.picture)
        return
    if not options.runs:
        print(tables(json.loads(options.rows.read_text("utf-8"))))
        return
    torch.set_num_threads(1)
    options.keep.mkdir(parents=True, exist_ok=True)
    models: dict[str, list[Seen]] = {}
    times: dict[str, dict[str, float]] = {}
    for name, run in (each.split("=", 1) for each in sorted(options.runs)):
        file = options.keep / f"{name}{'-rivals' if options.rivals else ''}.pt"
        if not file.exists():
            model, scene = load_run_model(Path(run.split(",")[0]))
            ensemble = [load_run_model(Path(other))[0] for other in run.split(",")[1:]]
            found, spent = look(model, scene, ensemble, rivals=options.rivals)
            torch.save(([tuple(v) for v in found], spent), file)
            print("measured", name, flush=True)
        found, times[name] = torch.load(file, weights_only=False)
        models[name] = [Seen(*v) for v in found]
    forms = [[*form.weights] for form in form_of.FORMS]
    if options.weights:  # the spread is that of the scenes of the fit: the larger one, over left-out scenes, ships
        for terms in forms:
            found = fitted([v for views in models.values() for v in views], terms)
            print({t: round(w, 4) for t, w in found.weights.items()}, found[1:])
        return
    columns = {}
    best = {}
    shapes = [("error map", forms[0], False), ("kinds apart", forms[0], True)]
    names = ("model alone", "image, alpha and deviation", "image and alpha")
    for label, terms, kinds in [*shapes, *((name, form, False) for name, form in zip(names, forms[1:], strict=True))]:
        best[label] = held_out(models, terms, kinds=kinds)
        columns[label] = figure_of(models, lambda n, v, b=best[label]: b[n].expect(v), ause)
    ships = Fitted(dict(form_of.FORMS[0].weights), form_of.TRANSFER, form_of.FORMS[0].peaked, form_of.FORMS[0].spread)
    columns["weights as shipped"] = figure_of(models, lambda _, v: ships.expect(v), ause)
    for rival in dict.fromkeys(r for views in models.values() for r in views[0].rivals):
        columns[rival] = figure_of(models, lambda _, v, r=rival: v.rivals[r], ause)
    chosen = best["error map"]
    of = lambda n, v: chosen[n].expect(v)  # noqa: E731
    without = {}
    for term in forms[0]:
        less = held_out(models, [t for t in forms[0] if t != term])
        without[term] = figure_of(models, lambda n, v, b=less: b[n].expect(v), ause)
    rank = lambda u, e: float(spearmanr(u, e).statistic)  # noqa: E731
    root = lambda u, e: ause(u, e, root=True)  # noqa: E731
    likely = lambda u, e: float((np.log(u) + e / u).mean())  # noqa: E731
    deviation = lambda _, v: v.rivals["deviation"]  # noqa: E731
    others = {
        "AUSE-RMSE": figure_of(models, of, root),
        "AUSE-RMSE, deviation": figure_of(models, deviation, root),
        "Spearman": figure_of(models, of, rank),
        "Spearman, deviation": figure_of(models, deviation, rank),
        "expected over measured mean error": figure_of(models, of, lambda u, e: float(u.mean() / e.mean())),
        # 90 % if exponential
        "errors below 2.303 expected": figure_of(models, of, lambda u, e: float((e < math.log(10) * u).mean())),
        "negative log likelihood": figure_of(models, of, likely),
        "of the view's true mean": figure_of(models, lambda _, v: np.full_like(v.error, v.error.mean()), likely),
    }
    deciles = np.zeros((2, 10))
    for name, views in models.items():
        for v in views:
            u = of(name, v)
            for i, part in enumerate(np.array_split(np.argsort(u), 10)):
                deciles[:, i] += u[part].mean(), v.error[part].mean()
    deciles /= sum(map(len, models.values()))
    quality = {name: [Quality.of(v, chosen[name]) for v in views] for name, views in models.items()}
    settings = [*dict.fromkeys(map(setting_of, models))]
    pairs = {
        f"{second} over {first}": found
        for i, first in enumerate(settings)
        for second in settings[i + 1 :]
        if (found := ranked(quality, first, second))
    }
    figures = {**columns, **{f"without {term}": each for term, each in without.items()}, **others}
    rows: dict[str, Any] = {
        name: {label: round(each[i], 4) for label, each in figures.items() if not math.isnan(each[i])}
        | {"views": [[round(x, 4) for x in v] for v in quality[name]]}
        for i, name in enumerate(models)
    }
    found = {**rows, "pairs": pairs, "deciles": deciles.round(4).tolist()}
    print(f"\n{tables(found)}")
    if options.rows:
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(each)}" for name, each in found.items())
        options.rows.write_text(f"{{\n{lines}\n}}\n")
    for name, spent in times.items():
        print(name, {k: round(v, 3) for k, v in spent.items()})


if __name__ == "__main__":
    main()
