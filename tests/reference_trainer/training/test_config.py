import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from reference_trainer.json_files import settings_from
from reference_trainer.training.assembly import check, make_regularizer
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density import DENSITY, AdaptiveDensity
from reference_trainer.training.recipes import RECIPES, with_recipe


def test_the_defaults_are_the_recipe_3dgs():
    assert dataclasses.replace(RECIPES["3dgs"].config, iterations=3_000) == TrainConfig()


@pytest.mark.parametrize("name", RECIPES)
def test_recipes_accept_changes_and_keep_the_rest(name):
    changed = with_recipe(name, sh_degree=2, dropout=0.3)
    assert (changed.sh_degree, changed.dropout) == (2, 0.3)
    whole = RECIPES[name].config
    assert dataclasses.replace(changed, sh_degree=whole.sh_degree, dropout=whole.dropout) == whole


def test_an_unknown_recipe_names_the_known_ones():
    with pytest.raises(ValueError, match=r"no recipe 'gsplat'.*3dgs, inria, fsgs"):
        with_recipe("gsplat")


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({}, ""),
        ({"dropout": 0.2}, "dropout(0.2)"),
        ({"noise": 0.8, "dropout": 0.2}, "dropout(0.2) + noise(0.8)"),
        ({"dropout": 0.2, "regularizer": "noise(0.8, scale=True)"}, "dropout(0.2) + noise(0.8, scale=True)"),
    ],
)
def test_all_regularizers_are_one_expression(settings, text):
    config = TrainConfig(**settings)
    assert config.regularizers == text
    assert len(make_regularizer(config)) == (text.count("+") + 1 if text else 0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("iterations", 0),
        ("seed", -1),
        ("seed", 2**63),
        ("dropout", 1.0),
        ("dropout", -0.1),
        ("dropout", math.nan),
        ("noise", -0.1),
        ("noise", math.nan),
        ("densify_gradient", math.inf),
        ("densify_gradient", -1.0),
        ("max_gaussians", -1),
        ("densify_until", -1),
        ("color_rate", -1.0),
        ("regularize_from", -1),
        ("sh_degree", 4),
        ("sh_every", -1),
        ("means_rate", 0.0),
        ("means_rate_final", -1e-6),
        ("initial_points", "some"),
        ("random_background", True),  # as it was before it had a third value
        ("initial_scale", 0.0),
        ("initial_opacity", 1.0),
        ("initial_opacity", 0.0),
        ("densify_from", -1),
        ("densify_every", -1),
        ("prune_size", 0.0),
        ("prune_size_from", -1),
        ("opacity_reset", 0.0),
        ("opacity_reset_every", -5),
        ("opacity_reset_from", -1),
        ("opacity_decay", 0.0),
        ("opacity_decay", 1.1),
    ],
)
def test_impossible_values_are_named(field, value):
    with pytest.raises(ValueError, match=f"{field} must .*{value}"):
        TrainConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("iterations", 1e4), ("seed", 1.5), ("sh_every", 2.0), ("max_gaussians", 1e6), ("sh_degree", True),
     ("opacity_reset_from", None)],
)  # fmt: skip
def test_counts_are_integers(field, value):
    """A training with another number had run, and its checkpoint was refused as damaged."""
    with pytest.raises(TypeError, match=rf"{field} .*integer, got {value!r}: .*int\(\)"):
        TrainConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("means_rate", np.float32(1e-4)), ("opacity_decay", torch.tensor(0.9)), ("noise", True), ("prune_size", "0.2")],
)
def test_rates_are_numbers_that_a_checkpoint_can_hold(field, value):
    """JSON knows no other, and read True as no number."""
    with pytest.raises(TypeError, match=rf"{field} .*number .*got .*: .*float\(\)"):
        TrainConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("analytic", np.bool_(True)), ("opacity_reset_over_white", 1), ("regularizer", None), ("loss", ["photometric"])],
)
def test_switches_and_expressions_are_those_that_a_checkpoint_can_hold(field, value):
    """JSON knows no bool of NumPy: the training had run when its checkpoint could not be written."""
    with pytest.raises(TypeError, match=f"{field} must be"):
        TrainConfig(**{"dropout": 0.2, field: value})


def test_a_rate_of_numpy_is_written_like_one_of_python():
    config = TrainConfig(dropout=np.linspace(0.0, 0.4, 5)[1], noise=np.float64(1e-5))
    assert config.regularizers == "dropout(0.1) + noise(1e-05)"
    check(config)
    read = json.loads(json.dumps(dataclasses.asdict(config)))
    assert settings_from(TrainConfig, read, "config.json") == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"regularizer": "dropout"}, "missing 1 required positional argument"),
        ({"loss": ""}, "at least one term"),
        ({"loss": "photometric(2.0)"}, "lambda_dssim must lie in"),
        ({"loss": "co_adaptation(-1.0)"}, "weight .*negative"),
        ({"density": "adaptive + adaptive"}, "one density strategy, got 2"),
        ({"renderer": ""}, "expected one renderer, got 0"),
    ],
)
def test_expressions_are_read_before_anything_is_trained(settings, message):
    with pytest.raises(ValueError, match=message):
        check(TrainConfig(**settings))


def test_only_what_the_renderer_lacks_is_named(monkeypatch):
    class Greedy(AdaptiveDensity):
        needs = frozenset({"absgrad", "models", "moments"})

    monkeypatch.setitem(DENSITY._factories, "greedy", Greedy)
    with pytest.raises(ValueError, match=r"greedy .*moments, .*gsplat"):
        check(TrainConfig(density="greedy", models=2, renderer="gsplat"))


@pytest.mark.parametrize("regularizer", [{"dropout": 0.2}, {"noise": 0.8}])
def test_regularizers_that_never_begin_are_refused(regularizer):
    """They would scale opacities at test time, of a model that never met them."""
    with pytest.raises(ValueError, match=r"regularize_from .*iterations \(5\), got 5"):
        TrainConfig(iterations=5, regularize_from=5, **regularizer)
    assert TrainConfig(iterations=5, regularize_from=4, **regularizer).regularize_from == 4
    assert TrainConfig(iterations=5, regularize_from=5).regularize_from == 5


def test_an_expectation_needs_something_random():
    with pytest.raises(ValueError, match="set dropout, noise"):
        TrainConfig(analytic=True)
    assert TrainConfig(analytic=True, noise=0.1, loss="photometric + co_adaptation(2.0)").analytic
