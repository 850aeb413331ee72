import dataclasses
import itertools
import math
import statistics

import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.ranking import VARIANTS, correlations, disagreements, group_labels, mean_of, ranking_study, score_view
from reference_trainer.camera import Camera
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.folder import CHECKPOINT, CONFIG
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.scene import View
from reference_trainer.studies.study import run_study
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

OPACITY = 0.95
VIEWS = 96


def model_of_layers(grays: list[float], size: float) -> TrainedModel:
    """Gray Gaussians behind one another, over black."""
    n = len(grays)
    positions = torch.tensor([[0.0, 0.0, 1.0 + i] for i in range(n)])
    colors = torch.tensor(grays)[:, None].expand(n, 3)
    gaussians = Gaussians.from_points(positions, colors, torch.full((n,), size), sh_degree=0, opacity=OPACITY)
    return TrainedModel(gaussians, torch.zeros(3))


def black_view(pixels: int) -> View:
    camera = Camera(torch.eye(4), float(pixels), float(pixels), pixels / 2, pixels / 2, pixels, pixels)
    return View("view", camera, torch.zeros(3, pixels, pixels))


def composites(grays: list[float], behind: float = 0.0) -> list[float]:
    """The pixel under each of the equally likely masks, the one that drops everything last."""
    out = []
    for mask in itertools.product([1, 0], repeat=len(grays)):
        color, light = 0.0, 1.0
        for keep, gray in zip(mask, grays, strict=True):
            color, light = color + keep * light * OPACITY * gray, light * (1 - keep * OPACITY)
        out.append(color + light * behind)
    return out


def test_quality_is_that_of_the_pixels_that_count():
    view = black_view(2)
    mask = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    photograph = (1 - mask).expand(3, 2, 2)  # right where it counts, as the wall is black, and wrong elsewhere
    found = score_view(
        model_of_layers([0.1, 0.1], 100.0), dataclasses.replace(view, image=photograph, mask=mask), index=0
    )
    gray = 0.1 * (1 - (1 - OPACITY) ** 2)
    assert found["psnr"] == pytest.approx(-20 * math.log10(gray), abs=0.1)


@pytest.fixture(scope="module")
def walls() -> dict[str, tuple[list[float], list[dict[str, float]]]]:
    """Two models of three layers that fill the view: equal ones, whose holes show black, and unequal darker ones."""
    view = black_view(2)
    grays = {"equal": [1.0, 1.0, 1.0], "unequal": [0.3, 0.7, 0.4]}
    return {
        name: (layers, [score_view(model_of_layers(layers, 100.0), view, index=i) for i in range(VIEWS)])
        for name, layers in grays.items()
    }


@pytest.mark.parametrize("name", ["equal", "unequal"])
def test_five_renders_without_a_hole_know_the_variance_given_no_hole(walls, name):
    """All five masks keep something in half of the views; they are then independent draws from such masks."""
    grays, rows = walls[name]
    limit, without_hole = statistics.pvariance(composites(grays)), statistics.pvariance(composites(grays)[:-1])
    for quantity in ("protocol_half", "repeat"):
        values = [row[quantity] for row in rows if math.isfinite(row[quantity])]
        assert 29 < len(values) < 69  # expected (7/8)^5 of 96 = 49, spread 4.9: 1e-4
        error = statistics.stdev(values) / math.sqrt(len(values))
        assert statistics.mean(values) == pytest.approx(0.8 * without_hole, abs=4 * error)  # 1e-4, the seed is fixed
        assert abs(statistics.mean(values) - 0.8 * limit) > 4 * error
        assert all(math.isfinite(row[quantity]) == (row[f"visible {quantity}"] == 1) for row in rows)
    values = [row["unconditioned"] for row in rows]
    assert statistics.mean(values) == pytest.approx(0.8 * limit, abs=4 * statistics.stdev(values) / math.sqrt(VIEWS))
    mean_alpha = 1 - (1 - OPACITY / 2) ** 3
    over_own_color = statistics.pvariance(composites(grays, statistics.mean(composites(grays)) / mean_alpha))
    for row in rows:
        assert row["exact_half"] == pytest.approx(limit, rel=1e-4)
        assert row["weighted_half"] == pytest.approx(limit, rel=1e-4)
        assert row["neutral_half"] == pytest.approx(over_own_color, rel=1e-4, abs=1e-7)
        assert row["first_order_half"] == pytest.approx(sum((OPACITY * gray) ** 2 for gray in grays) / 4, rel=1e-4)
        # The exact variance does not know of the masks: only the region is theirs.
        seen = math.isfinite(row["protocol_half"])
        assert row["limit_conditioned"] == pytest.approx(limit, rel=1e-4) if seen else True
        assert math.isfinite(row["limit_conditioned"]) == seen


def scores_of(rows: list[dict], strategy: str = "baseline", seed: int = 0, **settings) -> dict:
    views = [{"name": str(i), **row} for i, row in enumerate(rows)]
    of = {"scene": "wall", "split": "test", "strategy": strategy, "training_views": 3, "seed": seed, "gaussians": 3}
    return of | {"settings": settings, "views": views}


def test_conditioning_on_visibility_turns_an_order_around(walls):
    runs = [scores_of(rows, name) for name, (_, rows) in walls.items()]
    (row,) = disagreements(runs)
    assert row.pop("A / B") == "equal / unequal"
    higher = {variant for variant, ratio in row.items() if float(ratio) > 1}
    assert higher == {"exact", "exact_half", "unconditioned", "limit_conditioned", "weighted_half", "first_order_half"}
    table = correlations(runs)
    for sign, variant, against in (
        (-1, "protocol_half", "rho exact_half"), (-1, "neutral_half", "tau exact_half"),
        (1, "limit_conditioned", "rho exact_half"), (1, "neutral_half", "rho protocol"),
    ):  # fmt: skip
        assert table[variant][against] == pytest.approx(sign)


def test_regions_and_variances_are_crossed_as_the_names_say(tiny_scene):
    """Against the five renders themselves."""
    points = tiny_scene.points
    scales = torch.full((150,), 0.2)
    gaussians = Gaussians.from_points(points.positions, points.colors, scales, sh_degree=0, opacity=0.9)
    model, view = TrainedModel(gaussians, tiny_scene.background), tiny_scene.test[0]
    images, alphas = [], []

    def spy(opacity, view):
        image, alpha = model.render(opacity, view)
        images.append(image.double())
        alphas.append(alpha)
        return image, alpha

    model.ca_score(render_fn=spy)(gaussians.opacities, view, index=3)
    variance = torch.stack(images).var(0, correction=0).mean(0)
    covered = (torch.stack(alphas) > 0.8).all(0)
    limit = model.exact_ca_score()(gaussians.opacities, view)
    assert 0 < covered.sum() < limit.visible.sum() < covered.numel()
    row = score_view(model, view, index=3)
    assert row["protocol"] == row["protocol_half"] == pytest.approx(variance[covered].mean().item())
    assert row["unconditioned"] == pytest.approx(variance[limit.visible].mean().item())
    assert row["limit_conditioned"] == pytest.approx(limit.variance[covered].mean().item())
    assert row["exact"] == row["exact_half"] == limit.value
    assert row["repeat"] != row["protocol_half"]
    assert row["visible protocol_half"] == pytest.approx(covered.double().mean().item())


def test_the_weights_are_the_expected_alpha():
    """One small Gaussian: variance alpha^2/4 times the squared color, weight alpha/2; nowhere 0.8 on average."""
    model, view = model_of_layers([0.5], 0.1), black_view(16)
    alpha = model.render(model.gaussians.opacities, view)[1].double()
    row = score_view(model, view, index=0)
    assert row["weighted_half"] == pytest.approx(((alpha**3).sum() / alpha.sum()).item() / 4 * 0.5**2, rel=1e-4)
    assert math.isnan(row["exact_half"])
    assert math.isnan(row["unconditioned"])
    assert row["visible exact_half"] == 0


@pytest.fixture(scope="module")
def trained(tmp_path_factory, options, short):
    """Two short runs: dropout with noise, and neither."""
    folder = tmp_path_factory.mktemp("runs")
    results = run_experiment(options, short, folder / "both" / "seed_0", monitoring=Monitoring(0))
    config = TrainConfig(iterations=6, densify_gradient=1e9, seed=4)
    plain = Trainer(load_scene(options, seed=4), config)
    plain.train()
    plain.save(folder / "plain" / "seed_4" / CHECKPOINT)
    claim = {"scene": dataclasses.asdict(options), "config": dataclasses.asdict(config)}
    write_json(folder / "plain" / "seed_4" / CONFIG, claim)
    return [folder / "both" / "seed_0", folder / "plain" / "seed_4"], results


def test_scores_are_those_of_the_evaluation(trained):
    folders, results = trained
    study = ranking_study(folders[:1])
    ((name, case),) = study.cases.items()
    run = study.measure(**case)
    assert name.endswith("both/seed_0")
    assert (run["strategy"], run["training_views"], run["seed"]) == ("both", 3, 0)  # the folder
    assert run["scene"] == "synthetic (1/8)"
    assert run["gaussians"] == results["gaussians"]
    mean = results["mean"]["test"]
    for ours, theirs in (("psnr", "psnr"), ("protocol", "ca"), ("protocol_half", "ca_half"), ("exact", "ca_exact"),
                         ("visible protocol", "visible")):  # fmt: skip
        assert mean_of(run, ours) == pytest.approx(mean[theirs]), ours
    assert mean_of(run, "protocol") != mean_of(run, "protocol_half")


def test_a_study_leaves_numbers_tables_and_a_figure(trained, tmp_path):
    records = run_study(ranking_study(trained[0], views=1), tmp_path)
    plain = records["/".join(trained[0][1].parts[-3:])]
    assert plain["strategy"] == "plain"
    assert plain["views"][0]["protocol"] == plain["views"][0]["protocol_half"]
    assert [len(run["views"]) for run in records.values()] == [1, 1]
    text = (tmp_path / "ranking.md").read_text()
    assert "(test views)" in text
    assert "## synthetic (1/8): 2 runs, 1 views" in text
    with Image.open(tmp_path / "ranking.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 50


@pytest.mark.parametrize(("keywords", "message"), [({"split": "val"}, "split .*'train' or 'test', got 'val'"),
                                                    ({"views": 0}, "views .*at least 1")])  # fmt: skip
def test_refusals(trained, keywords, message):
    with pytest.raises(ValueError, match=message):
        ranking_study(trained[0], **keywords)


def made(strategy: str, seed: int, exact: float, protocol: float = 1.0, psnr: float = 20.0, **settings) -> dict:
    row = dict.fromkeys(VARIANTS, exact) | {"protocol": protocol, "psnr": psnr}
    row |= {f"visible {name}": 0.5 for name in ("protocol", "protocol_half", "exact_half")}
    return scores_of([row], strategy, seed, **settings)


def test_correlations_are_those_of_ranks_and_pairs():
    values = [(3.0, 1.0, 20.0), (2.0, 2.0, 21.0), (1.0, 2.0, 20.5), (4.0, 0.5, 19.0), (math.nan, 0.1, 30.0)]
    table = correlations([made("a", i, *value) for i, value in enumerate(values)])
    # Ranks less their mean: protocol -0.5, 1, 1, -1.5 and exact 0.5, -0.5, -1.5, 1.5; of six pairs one agrees.
    assert table["protocol"]["rho exact_half"] == pytest.approx(-4.5 / math.sqrt(4.5 * 5))
    assert table["exact"]["tau psnr"] == pytest.approx((1 - 5) / 6)
    # With the run that has no exact score: 0, 1.5, 1.5, -1, -2 and -1, 1, 0, -2, 2.
    assert table["protocol"]["rho psnr"] == pytest.approx(-0.5 / math.sqrt(9.5 * 10))
    assert correlations([made("a", 0, 1.0)])["exact"]["rho protocol"] is None


def test_disagreements_are_of_means_over_seeds():
    runs = [made("a", 0, 1.0, 4.0), made("a", 1, 3.0, 5.0), made("b", 0, 2.5, 3.0), made("b", 1, 2.5, 2.0)]
    (row,) = disagreements(runs)
    assert row["A / B"] == "a / b"
    assert row["exact"] == "0.8"  # the seeds of a lie on both sides
    assert row["protocol"] == "**1.8**"
    assert disagreements([made("a", 0, 1.0, 1.0), made("b", 0, 2.0, 2.0)]) == []
    assert disagreements([made("a", 0, math.nan, 2.0), made("b", 0, 2.0, 1.0)]) == []  # one opinion only


def test_runs_with_other_settings_are_no_seeds_of_one_strategy():
    runs = [made("a", 0, 1.0, iterations=5, points="x"), made("a", 1, 1.0, iterations=9, points="x")]
    assert group_labels(runs) == ["a, iterations 5", "a, iterations 9"]
    assert group_labels(runs[:1] * 2) == ["a"] * 2
    assert group_labels([runs[0], runs[0] | {"training_views": 6}]) == ["a, 3 views", "a, 6 views"]


def test_a_run_without_a_value_is_shown_as_such(trained, tmp_path):
    study = ranking_study(trained[0])
    half = scores_of([made("b", 0, 0.004)["views"][0], made("b", 0, math.nan)["views"][0]], "b")
    records = {"a": made("a", 0, math.nan), "b": half}  # what has no value comes last
    lines = [line for line in study.report(records).splitlines() if line.startswith(("| b", "| a"))]
    assert "| 4 (1/2) |" in lines[0]
    assert lines[1].count("n/a") == len(VARIANTS) - 1
    figure = Figure()
    study.plot(records, figure)
    figure.savefig(tmp_path / "figure.png")
