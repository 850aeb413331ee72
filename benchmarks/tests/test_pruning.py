import dataclasses
import json
import math

import pytest
import torch
from matplotlib.figure import Figure

from benchmarks import pruning as pruning_module
from benchmarks.pruning import CRITERIA, prune_lowest, pruning_order, pruning_study, train_on
from ca_reg import attribute
from reference_trainer.evaluation.evaluate import evaluate
from reference_trainer.evaluation.results import write_json
from reference_trainer.evaluation.shares import blend_weights
from reference_trainer.runs.folder import CHECKPOINT, CONFIG
from reference_trainer.runs.run import model_of
from reference_trainer.studies.study import run_study
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import adaptive
from reference_trainer.training.trainer import Trainer


def opaque(config: TrainConfig) -> TrainConfig:
    """Opaque enough to have a score after a few steps."""
    return dataclasses.replace(config, initial_opacity=0.9, opacity_reset_every=0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, tiny_scene, busy):
    """A trained checkpoint, its scene, and the order of removal by every criterion."""
    trainer = Trainer(tiny_scene, opaque(busy))
    trainer.train()
    path = tmp_path_factory.mktemp("trained") / "checkpoint.pt"
    trainer.save(path)
    generator = torch.Generator().manual_seed(0)
    return path, tiny_scene, pruning_order(model_of(trainer), trainer.views, generator=generator)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("fraction", [0.0, 0.013, 0.4])
def test_exactly_the_lowest_go_and_the_others_are_untouched(trained, criterion, fraction):
    path, scene, order = trained
    before, trainer = (Trainer.load(path, scene) for _ in range(2))
    n = len(before.gaussians)
    values = order[criterion].tolist()
    kept = sorted(sorted(range(n), key=lambda i: (values[i], i))[round(fraction * n) :])
    prune_lowest(trainer, order[criterion], fraction)
    assert len(trainer.gaussians) == len(kept) == n - round(fraction * n)
    old, new = before.optimizer.state_dict(), trainer.optimizer.state_dict()
    for name, x in old["gaussians"].items():
        assert torch.equal(new["gaussians"][name], x[kept])
        moments = old["moments"][name]
        assert moments["exp_avg_sq"].any()
        for moment in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(new["moments"][name][moment], moments[moment][kept])
        assert new["moments"][name]["step"] == moments["step"]
    assert trainer.density.statistics.steps.shape == (len(kept),)
    trainer.train_step()  # config and statistics fit the smaller set


def test_the_orders_are_what_their_names_say(trained):
    path, scene, order = trained
    trainer = Trainer.load(path, scene)
    model = model_of(trainer)
    opacities = model.gaussians.opacities
    score = model.exact_ca_score(drop_rate=0.5)
    parts = [attribute(score, model.shares, opacities, view) for view in trainer.views]
    shares = torch.stack([part.shares for part in parts if math.isfinite(part.result.value)]).mean(0)
    weights = blend_weights(model, trainer.views)
    assert list(order) == list(CRITERIA)
    assert torch.equal(order["lowest opacity"], opacities)
    assert torch.equal(order["lowest blend weight"], weights)
    torch.testing.assert_close(order["lowest share"], shares, rtol=1e-12, atol=0)
    assert torch.equal(order["highest share"], -order["lowest share"])
    seen = (weights > 0) & (shares > 0)
    torch.testing.assert_close(order["highest share per weight"][seen], -(shares / weights)[seen], rtol=1e-12, atol=0)
    again = pruning_order(model, trainer.views, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(again.pop("random"), order["random"])
    assert all(torch.equal(x, order[name]) for name, x in again.items())


def test_training_on_changes_no_numbers_and_moves_means_slowly(trained, monkeypatch):
    path, scene, order = trained
    trainer = Trainer.load(path, scene)
    trainer.density.config = dataclasses.replace(
        trainer.config, iterations=99, densify_from=1, densify_every=1, opacity_reset_every=1, opacity_reset_from=1
    )
    prune_lowest(trainer, order["random"], 0.2)
    count, start = len(trainer.gaussians), trainer.step
    means = trainer.gaussians.means.detach().clone()
    rates: list[float] = []
    set_rate = trainer.optimizer.set_means_rate
    monkeypatch.setattr(trainer.optimizer, "set_means_rate", lambda rate: (rates.append(rate), set_rate(rate)))
    for name in ("clone", "split", "prune", "reset_opacity"):
        monkeypatch.setattr(adaptive, name, lambda *args, **rest: pytest.fail("the set was changed"))
    train_on(trainer, 6)
    assert (trainer.step, len(trainer.gaussians)) == (start + 6, count)
    assert rates == pytest.approx([trainer.config.means_rate_final * scene.extent] * 6)
    assert not torch.equal(trainer.gaussians.means, means)
    assert (trainer.config.dropout, trainer.config.noise) == (0.2, 0.4)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, options, tiny_scene, busy):
    """Two runs that differ in their seed, what is measured of each model, and their scene."""
    view = tiny_scene.test[0]
    masked = dataclasses.replace(view, mask=(view.image[0] > view.image[0].median()).float())  # of some of its pixels
    root, scene, out = tmp_path_factory.mktemp("runs"), dataclasses.replace(tiny_scene, test=(masked,)), {}
    for seed in range(2):
        trainer = Trainer(scene, dataclasses.replace(opaque(busy), seed=seed))
        trainer.train()
        folder = root / f"seed_{seed}"
        trainer.save(folder / CHECKPOINT)
        config = {"scene": dataclasses.asdict(options), "config": dataclasses.asdict(trainer.config)}
        write_json(folder / CONFIG, config)
        out[folder] = evaluate(model_of(trainer), {"test": scene.test})
    return out, scene


@pytest.mark.slow
def test_what_was_pruned_is_measured_before_and_after_further_steps(runs, tmp_path, monkeypatch):
    (folder, evaluation), scene = next(iter(runs[0].items())), runs[1]
    monkeypatch.setattr(
        pruning_module, "load_run", lambda folder, device: Trainer.load(folder / CHECKPOINT, scene, device)
    )
    study = pruning_study([folder], fractions=[0.25], refine=1)
    whole, refined, *pruned = run_study(study, tmp_path).values()
    assert (whole["steps"], refined["steps"]) == (0, 1)
    assert (whole["psnr"], whole["gaussians"]) == (evaluation.mean("test", "psnr"), evaluation.gaussians)
    assert whole["ca_protocol"] == evaluation.mean("test", "ca_half")
    assert refined["psnr"] != whole["psnr"]
    left = evaluation.gaussians - round(0.25 * evaluation.gaussians)
    done = [(name, 0.25, steps, left) for name in CRITERIA for steps in (0, 1)]
    assert [(x["criterion"], x["fraction"], x["steps"], x["gaussians"]) for x in pruned] == done
    more = pruning_study([folder], fractions=[0.25, 0.5], refine=0).cases
    assert {name: case for name, case in study.cases.items() if case["steps"] == 0}.items() <= more.items()


def test_the_report_is_of_mean_and_spread_over_runs(runs):
    def record(run: float, criterion: str, fraction: float, steps: int) -> dict:
        what = {"criterion": criterion, "fraction": fraction, "steps": steps, "gaussians": 90}
        scores = {"psnr": 20 + run - fraction, "ca_exact": math.nan, "covered": 0.5}
        return what | scores | {"ca_protocol": (2 + run + steps) * 1e-3}

    plan = [("nothing removed", 0.0), *((name, part) for part in (0.1, 0.4) for name in CRITERIA)]
    found = {str((run, *each, n)): record(run, *each, n) for run in (0.0, 0.4, 0.8) for each in plan for n in (0, 7)}
    study = pruning_study([*runs[0]])
    text = study.report(found)
    assert "3 runs" in text.splitlines()[0]
    as_pruned, refined = text.split("## After 7 further steps")
    for part, protocol in ((as_pruned, "2.40 ± 0.40"), (refined, "9.40 ± 0.40")):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if "%" in line]
        assert len(rows) == 1 + len(plan)  # with the header
        assert rows[-1] == ["random", "40%", "90", "20.00 ± 0.40", "n/a", "50 ± 0", protocol]
    figure = Figure()
    study.plot(found, figure)
    lines = figure.axes[0].get_legend_handles_labels()[0]
    assert (len(figure.axes), len(lines)) == (4, len(CRITERIA))
    x, y = lines[0].lines[0].get_data()
    assert [*x] == [0, 10, 40]
    assert [*y] == pytest.approx([20.4, 20.3, 20.0])


def test_mistakes(runs, tmp_path):
    run = next(iter(runs[0]))
    for fractions in ([], [0.0], [0.2, 1.0]):
        with pytest.raises(ValueError, match=r"each in \(0, 1\), got"):
            pruning_study([run], fractions=fractions)
    with pytest.raises(ValueError, match=r"refine .*negative, got -1"):
        pruning_study([run], refine=-1)
    with pytest.raises(FileNotFoundError, match="holds no run"):
        pruning_study([tmp_path])
    with pytest.raises(ValueError, match=r"fraction .*\[0, 1\), got 1"):
        prune_lowest(None, torch.zeros(3), 1.0)


def test_runs_of_two_kinds_have_no_mean(runs, tmp_path):
    run = next(iter(runs[0]))
    other = tmp_path / "other"
    other.mkdir()
    (other / CHECKPOINT).touch()
    config = json.loads((run / CONFIG).read_text())
    config["config"]["dropout"] = 0.5
    write_json(other / CONFIG, config)
    with pytest.raises(ValueError, match=r"differ in dropout; .*seed"):
        pruning_study([run, other])
