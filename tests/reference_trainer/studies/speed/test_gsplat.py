"""The calls that time gsplat. With a CUDA device: ``pytest tests/reference_trainer/studies/speed/test_gsplat.py``."""

import pytest
import torch
from stand_ins.gsplat import rasterization

from reference_trainer.render.gsplat import render_by
from reference_trainer.studies.speed import gsplat as module
from reference_trainer.studies.speed.calls import SUBJECT, gradients, image
from reference_trainer.studies.speed.gsplat import gsplat_calls, gsplat_draw
from reference_trainer.studies.speed.measure import PASSES
from reference_trainer.studies.speed.workloads import WorkloadSpec

TINY = WorkloadSpec(60, 40, 24, 0.05)


def test_without_a_gpu_there_is_nothing_to_time():
    assert gsplat_calls(TINY.make()) == {}


def test_the_calls_render_the_workload(monkeypatch):
    monkeypatch.setattr(
        module, "load_gsplat_render", lambda device: lambda *args, **kw: render_by(rasterization, *args, **kw)
    )
    workload = TINY.make()
    calls = gsplat_calls(workload)
    assert set(calls) == {f"gsplat {x}" for x in PASSES}
    torch.testing.assert_close(calls["gsplat forward"](), image(SUBJECT, workload))
    ours = gradients(SUBJECT, workload)
    for name, x in calls["gsplat forward+backward"]().items():
        torch.testing.assert_close(x, ours[name])


@pytest.mark.gpu
def test_gsplat_renders_the_same_workload():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    pytest.importorskip("gsplat", exc_type=ImportError)
    workload = TINY.make().to("cuda")
    draw = gsplat_draw(torch.device("cuda"))
    assert draw is not None
    torch.testing.assert_close(image(draw, workload), image(SUBJECT, workload), rtol=0, atol=1e-2)
