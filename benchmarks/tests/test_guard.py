import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pages import lines_missing

from benchmarks import guard as measured
from benchmarks.guard import RULES, keeps, main, table, unexplained
from reference_trainer.evaluation.shares import guard, unseen_shares
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import initial_gaussians


def test_a_run_under_rules(tmp_path, capsys):
    """The chosen rule is that of the package, and what is measured is not measured again."""
    run, out = tmp_path / "run", tmp_path / "rules.json"
    config = TrainConfig(iterations=60, dropout=0.2, densify_every=0, opacity_rate=0.2)
    run_experiment(SceneOptions("synthetic", downscale=8), config, run, monitoring=Monitoring(0))
    chosen = "ratio 16, 0.3 %, together 5 %"
    main("measure", (run,), out, (chosen, "ratio 2, 0.3 %"))
    none, *rules = json.loads(out.read_text())
    assert [row["rule"] for row in rules] == [chosen, "ratio 2, 0.3 %"]
    assert none["removed"] == 0
    assert rules[0]["removed"] <= rules[1]["removed"]
    assert all(set(row["views"]) == {"held-out", "test", "train", "shared"} for row in (none, *rules))
    model, scene = load_run_model(run)
    kept = keeps(model, scene, {}, **RULES[chosen])[0]
    assert torch.equal(kept, guard(model, scene).keep)
    pilot = RULES["pilot: 15 twice"]
    assert not keeps(model, scene, {}, **pilot)[0].all()
    assert keeps(model, scene, {}, **pilot, spared=-99.0)[0].all()  # photographs that would have to gain 99 dB
    before = out.read_text()
    capsys.readouterr()
    main("measure", (run,), out, (chosen,))
    assert out.read_text() == before
    main("table", (out,))
    assert f"| {run.name} |" in capsys.readouterr().out


@torch.no_grad()
def test_what_explains_photographs_stays_whatever_it_risks():
    """One large Gaussian amid the scene: a veil that all cameras see, unless the photographs show it, too."""
    scene = synthetic_scene(width=64, height=48, points=1_500)
    start, camera = initial_gaussians(scene, TrainConfig()), scene.train[1].camera
    start = replace(start, opacity_logits=torch.full_like(start.opacity_logits, 2.0))
    place = camera.position + camera.project(start.means)[1].median() * camera.forward
    giant = dict(
        Gaussians.from_points(place[None], torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([3.0]), sh_degree=3).named()
    )
    both = Gaussians.from_named({name: torch.cat([x, giant[name]]) for name, x in start.named()})
    alone, model = (TrainedModel(each, scene.background, "dropout(0.2)") for each in (start, both))
    shares, *_ = unseen_shares(model, unseen_views(scene))
    assert shares[-1] > 0.02 * shares.sum()
    veiled, walled = (
        [replace(view, image=each.test_rendering(view).image.clamp(0, 1)) for view in scene.train]
        for each in (alone, model)
    )
    assert torch.equal(unexplained(model, veiled, shares, 5.0), torch.arange(len(both)) == len(start))
    assert not unexplained(model, walled, shares, 5.0).any()


@pytest.mark.parametrize("file", ["guard_by_shares", "guard_unneeded", "guard_worth"])
def test_the_page_has_the_models_that_a_rule_touches(file):
    here = Path(measured.__file__).parent
    printed = table(json.loads((here / "data" / f"{file}.json").read_text("utf-8")))
    assert [line for line in lines_missing(printed, "guard.md") if not line.endswith(" (0) |")] == []
