"""What surrounds a rendering is timed on the right thing."""

import torch
from devices import slow_on_card

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.speed import steps
from reference_trainer.studies.speed.calls import SUBJECT, image
from reference_trainer.studies.speed.steps import masked_renders, training_step
from reference_trainer.studies.speed.workloads import WorkloadSpec


@slow_on_card
def test_a_step_and_its_parts_are_timed_with_all_bands(device, monkeypatch):
    degrees = []
    render = steps.render_gaussians
    monkeypatch.setattr(
        steps, "render_gaussians", lambda *args, **kw: degrees.append(kw["sh_degree"]) or render(*args, **kw)
    )
    result = training_step(SceneOptions("synthetic", downscale=8), repeats=2, device=device)
    assert (result["scene"], result["width"], result["height"]) == ("synthetic", 20, 15)
    assert result["gaussians"] > 0
    assert list(result["seconds"]) == ["step", "forward", "loss", "backward", "optimizer"]
    assert all(len(x) == 2 and min(x) > 0 for x in result["seconds"].values())
    assert degrees == [3, 3, 3]


def test_masked_renders_draw_the_workload(device, monkeypatch):
    seen = []
    model_render = steps.Model.render

    def spy(self, opacities, view):
        out = model_render(self, opacities, view)
        seen.append((out[0], int((opacities > 0).sum())))
        return out

    monkeypatch.setattr(steps.Model, "render", spy)
    workload = WorkloadSpec(80, 40, 24, 0.06).make().to(device)
    plain, score = masked_renders(workload).values()
    plain()
    assert torch.allclose(seen[0][0], image(SUBJECT, workload), atol=1e-5)
    assert [n for _, n in seen] == [80] * 5
    score()
    assert len(seen) in (5, 10)  # a renderer that shares work between masks does not come by here
    assert all(n < 80 for _, n in seen[5:])
