import dataclasses
import math

import pytest

from reference_trainer.training.config import PRESETS, TrainConfig, with_preset


def test_the_defaults_are_the_fsgs_preset():
    assert dataclasses.replace(PRESETS["fsgs"], iterations=3_000) == TrainConfig()


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_accept_changes_and_keep_the_rest(name):
    changed = with_preset(name, iterations=7, dropout=0.2)
    assert (changed.iterations, changed.dropout) == (7, 0.2)
    assert dataclasses.replace(changed, iterations=PRESETS[name].iterations, dropout=0.0) == PRESETS[name]


def test_an_unknown_preset_names_the_known_ones():
    with pytest.raises(ValueError, match=r"no preset 'gsplat'.*fsgs, inria, binocular"):
        with_preset("gsplat")


@pytest.mark.parametrize(("compensate", "scale"), [(False, 0.8), (True, 1.0)])
def test_test_time_scale(compensate, scale):
    assert TrainConfig(dropout=0.2, compensate=compensate).test_time_scale == scale


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("iterations", 0),
        ("seed", -1),
        ("dropout", 1.0),
        ("dropout", -0.1),
        ("dropout", math.nan),
        ("noise", -0.1),
        ("noise", math.nan),
        ("densify_gradient", math.inf),
        ("regularize_from", -1),
        ("sh_degree", 4),
        ("sh_every", 0),
        ("lambda_dssim", 1.5),
        ("means_rate", 0.0),
        ("means_rate_final", -1e-6),
        ("initial_points", "some"),
        ("initial_scale", 0.0),
        ("initial_opacity", 1.0),
        ("initial_opacity", 0.0),
        ("densify_from", -1),
        ("densify_every", -1),
        ("prune_size", 0.0),
        ("prune_size_from", -1),
        ("opacity_reset", 0.0),
        ("opacity_reset_every", -5),
        ("opacity_decay", 0.0),
        ("opacity_decay", 1.1),
        ("ca_weight", -1.0),
        ("ca_weight", 1.0),
    ],
)
def test_impossible_values_are_named(field, value):
    with pytest.raises(ValueError, match=f"{field} must .*{value}"):
        TrainConfig(**{field: value})


def test_scaling_by_the_mean_of_the_noise_needs_noise_at_the_plain_opacities():
    with pytest.raises(ValueError, match=r"scale_noise .* set noise"):
        TrainConfig(scale_noise=True, dropout=0.2)
    with pytest.raises(ValueError, match="scale_noise does not go with inverted dropout"):
        TrainConfig(scale_noise=True, noise=0.8, dropout=0.2, compensate=True)
    assert TrainConfig(scale_noise=True, noise=0.8, dropout=0.2).test_time_scale == 0.8
    assert TrainConfig(scale_noise=True, noise=0.8, compensate=True).noise == 0.8


@pytest.mark.parametrize("regularizer", [{"dropout": 0.2}, {"noise": 0.8}])
def test_regularizers_that_never_begin_are_refused(regularizer):
    """They would scale opacities at test time, of a model that never met them."""
    with pytest.raises(ValueError, match=r"regularize_from must be below iterations \(5\), got 5"):
        TrainConfig(iterations=5, regularize_from=5, **regularizer)
    assert TrainConfig(iterations=5, regularize_from=4, **regularizer).regularize_from == 4
    assert TrainConfig(iterations=5, regularize_from=5).regularize_from == 5


def test_an_expectation_needs_something_random():
    with pytest.raises(ValueError, match="set dropout or noise"):
        TrainConfig(analytic=True)
    assert TrainConfig(analytic=True, noise=0.1, ca_weight=2.0).ca_weight == 2.0
