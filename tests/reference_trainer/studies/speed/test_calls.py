"""What is timed is the same for both renderers."""

import torch

from reference_trainer.studies.speed.calls import BASELINE, SUBJECT, gradients, image
from reference_trainer.studies.speed.workloads import WorkloadSpec


def test_renderer_and_baseline_do_the_same(device):
    workload = WorkloadSpec(80, 40, 24, 0.06).make().to(device, torch.float64)
    assert torch.allclose(image(SUBJECT, workload), image(BASELINE, workload), rtol=0, atol=1e-10)
    found, true = gradients(SUBJECT, workload), gradients(BASELINE, workload)
    assert list(found) == list(true) == list(workload.parameters)
    for name in true:
        assert float((found[name] - true[name]).norm() / true[name].norm()) < 1e-8


def test_the_gradients_are_those_of_the_mean_squared_error():
    workload = WorkloadSpec(20, 16, 16, 0.1).make().to(dtype=torch.float64)
    gradient = gradients(BASELINE, workload)["colors"]
    step = torch.zeros_like(workload.colors)
    step[3] = 1.0
    changes = []
    for sign in (1, -1):
        parameters = {**workload.parameters, "colors": workload.colors + sign * step}
        changes.append((BASELINE(parameters, workload.camera) - workload.target).square().mean())
    # The loss is quadratic in the colours: the central difference is exact.
    assert torch.allclose((changes[0] - changes[1]) / 2, gradient[3].sum(), rtol=1e-9)
