"""Limits and the bounds that follow from them."""

import pytest
import torch
from devices import slow_on_card
from oracles import brute_force

from reference_trainer.studies.speed.limits import Limits, bounds, covered_pairs, measure_limits
from reference_trainer.studies.speed.workloads import WorkloadSpec


@slow_on_card
def test_limits_are_rates_in_the_right_units(device):
    limits = measure_limits(device, repeats=1)
    for rate in (limits.exp, limits.exp2, limits.copy):
        assert 1e6 < rate < 1e15  # a factor of 1000 in the units would be seen


def test_bounds_count_pairs_and_bytes():
    workload = WorkloadSpec(10, 8, 6, 0.1).make()
    found = bounds(Limits(exp=2e9, exp2=4e9, copy=1e9), workload, pairs=1000)
    floats = 10 * (3 + 4 + 3 + 1 + 3) + 3 * 8 * 6
    assert found == pytest.approx({"exp": 1000 / 4e9, "copy": 4 * floats / 1e9})


def test_pairs_are_those_that_brute_force_draws():
    # Some ellipses reach beyond the picture, some lie outside.
    workload = WorkloadSpec(40, 30, 20, 0.02).make().to(dtype=torch.float64)
    drawn = [
        (brute_force(*(x[i : i + 1] for x in workload.parameters.values()), workload.camera)[1] > 0).sum().item()
        for i in range(40)
    ]
    assert covered_pairs(workload) == sum(drawn)
    assert min(drawn) == 0
