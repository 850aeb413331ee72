import json

import torch

from benchmarks.guard import RULES, keeps, main
from reference_trainer.evaluation.shares import guard
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig


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
    assert all(set(row["views"]) == {"held-out", "test", "train"} for row in (none, *rules))
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
