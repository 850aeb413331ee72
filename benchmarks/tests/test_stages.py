"""The stages add up to a rendering and its gradients: the bookkeeping, not the speed."""

import itertools

import pytest
import torch

from benchmarks.calls import gradients, image, render_with
from benchmarks.stages import STAGES, staged
from benchmarks.workloads import WorkloadSpec, covered_pairs


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_the_stages_do_what_a_rendering_and_its_gradient_do(engine):
    workload = WorkloadSpec(80, 40, 24, 0.06).make()
    ticks = itertools.count()
    found = staged(workload, engine, lambda: float(next(ticks)))
    render_fn = render_with(engine)
    torch.testing.assert_close(found.image, image(render_fn, workload))
    for name, true in gradients(render_fn, workload).items():
        torch.testing.assert_close(found.gradients[name], true)
    # The clock is read twice around the binning, which is no part of the projection, and once after every stage.
    assert found.seconds == dict.fromkeys(STAGES, 1.0) | {"projection": 2.0}
    assert 64 * found.entries >= covered_pairs(workload)
