"""What is timed is the same for everything that renders."""

import pytest
import torch

from benchmarks import calls
from benchmarks.calls import BASELINE, gradients, image, others_on, render_with
from benchmarks.workloads import WorkloadSpec
from reference_trainer.render import render

TINY = WorkloadSpec(80, 40, 24, 0.06)


@pytest.mark.parametrize("name", ["numba", "torch", "gsplat"])
def test_everything_renders_the_same(name, monkeypatch):
    monkeypatch.setattr(calls, "load_gsplat_render", lambda device: render)  # gsplat's has the same arguments
    workload = TINY.make()
    precise, render_fn = workload.to(dtype=torch.float64), others_on(torch.device("cpu"))[name]
    # The largest errors are pairs at the cut of 1/255, of which there are none here.
    assert (image(render_fn, workload) - image(BASELINE, precise)).abs().max() < 1e-5
    found, true = gradients(render_fn, workload), gradients(BASELINE, precise)
    assert list(found) == list(true) == list(workload.parameters)
    for x in true:
        assert (found[x] - true[x]).norm() / true[x].norm() < 1e-3


def test_without_a_gpu_there_is_no_gsplat():
    assert list(others_on(torch.device("cpu"))) == ["numba", "torch"]


@pytest.mark.gpu
def test_gsplat_renders_the_same_workload():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    pytest.importorskip("gsplat", exc_type=ImportError)
    workload = TINY.make().to("cuda")
    found = image(others_on(torch.device("cuda"))["gsplat"], workload)
    torch.testing.assert_close(found, image(render_with("torch"), workload), rtol=0, atol=1e-2)


def test_the_gradients_are_those_of_the_mean_squared_error():
    workload = WorkloadSpec(20, 16, 16, 0.1).make().to(dtype=torch.float64)
    gradient = gradients(BASELINE, workload)["colors"]
    step = torch.zeros_like(workload.colors)
    step[3] = 1.0
    changes = []
    for sign in (1, -1):
        parameters = {**workload.parameters, "colors": workload.colors + sign * step}
        changes.append((BASELINE(parameters, workload.camera) - workload.target).square().mean())
    # The loss is quadratic in the colors: the central difference is exact.
    assert torch.allclose((changes[0] - changes[1]) / 2, gradient[3].sum(), rtol=1e-9)
