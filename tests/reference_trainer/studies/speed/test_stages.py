"""The stages add up to a rendering and its gradients: the bookkeeping, not the speed."""

import time

import torch

from reference_trainer.studies.speed.calls import SUBJECT, gradients, image
from reference_trainer.studies.speed.limits import covered_pairs
from reference_trainer.studies.speed.stages import STAGES, staged
from reference_trainer.studies.speed.workloads import WorkloadSpec


def test_the_stages_do_what_a_rendering_and_its_gradient_do(device):
    workload = WorkloadSpec(80, 40, 24, 0.06).make().to(device, torch.float64)
    start = time.perf_counter()
    found = staged(workload)
    whole = time.perf_counter() - start
    assert torch.allclose(found.image, image(SUBJECT, workload), rtol=0, atol=1e-12)
    for name, true in gradients(SUBJECT, workload).items():
        assert torch.allclose(found.gradients[name], true, rtol=1e-9, atol=1e-14)
    assert tuple(found.seconds) == STAGES
    assert min(found.seconds.values()) > 0
    assert sum(found.seconds.values()) <= whole
    assert found.evaluated >= covered_pairs(workload)
