import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import sweep_tasks
from stand_ins.engine import Here
from waiting import PATIENCE, until

from benchmarks import plan as plan_module
from benchmarks.plan import ALTERNATIVES, plan_table, shortened, study_plan, variants
from benchmarks.plan_parts import parts_of_a_step
from reference_trainer.runs.engines.engine import Task
from reference_trainer.runs.engines.processes import Processes
from reference_trainer.runs.engines.run_all import run_all
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import Plan, PlanItem
from reference_trainer.training.trainer import Trainer

TWO = Plan(
    (
        PlanItem("bands", "left out", "few views", {"sh_degree": 0}),
        PlanItem("depth", "left out", "by construction"),
        PlanItem("size", "reduced", "random", {"initial_scale": 0.5}),
    )
)


TESTS = Path(sweep_tasks.__file__).parent


@pytest.fixture(scope="module")
def options():
    return SceneOptions("synthetic", downscale=8)


@pytest.fixture(scope="module")
def short():
    return TrainConfig(
        iterations=11, dropout=0.2, noise=0.3, sh_every=4, densify_from=2, densify_every=4, densify_gradient=2e-3
    )


@pytest.fixture(scope="module")
def studied(tmp_path_factory, options, short):
    out, said = tmp_path_factory.mktemp("plan"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan_module, "Processes", Here)
        records = study_plan(
            options, out, config=short, iterations=4, seeds=2, alternatives=["no densification"], say=said.append
        )
    return out, records, said


def test_every_changing_item_is_tried_alone_and_with_the_others():
    tried = variants(TWO, TrainConfig(), ["initial size 1/2", "SH degree 1"])
    assert list(tried) == ["as asked", "bands", "size", "the whole plan", "SH degree 1"]  # 1/2 is there as "size"
    assert tried["bands"] == TrainConfig(sh_degree=0)
    assert tried["the whole plan"] == TrainConfig(sh_degree=0, initial_scale=0.5)


def test_an_unknown_alternative_names_the_known_ones():
    with pytest.raises(ValueError, match=r"no alternatives \['no sun'\]; choose of SH degree 0"):
        variants(TWO, TrainConfig(), ["no sun"])


def test_the_help_names_the_alternatives():
    assert all(f'"{name}"' in plan_module.plan.__doc__ for name in ALTERNATIVES)


def test_a_shortened_schedule_keeps_its_proportions():
    config = shortened(TrainConfig(iterations=3_000), 300)
    assert (config.iterations, config.sh_every, config.densify_from, config.opacity_reset_from) == (300, 50, 50, 200)
    assert shortened(TrainConfig(iterations=500), 500) == TrainConfig(iterations=500)


@pytest.mark.slow
def test_the_study_trains_what_it_says(studied):
    out, records, said = studied
    assert [(record["variant"], record["config"]["seed"]) for record in records] == [
        (name, seed) for seed in (0, 1) for name in ("as asked", "SH bands", "no densification")
    ]
    assert [record["config"]["sh_degree"] for record in records] == [3, 2, 3] * 2
    assert [record["config"]["densify_every"] for record in records] == [4, 4, 0] * 2
    assert all(record["cpu_seconds"] > 0 and record["peak_bytes"] > 2**20 for record in records)
    assert [record["parts"] is not None for record in records] == [True] + [False] * 5
    assert records == json.loads((out / "plan_study.json").read_text())["trainings"]
    assert (out / "plan_study.md").read_text() == said[-1] == plan_table(records)


@pytest.mark.slow
def test_a_second_call_trains_nothing(studied, options, short, monkeypatch):
    out, records, _ = studied
    monkeypatch.setattr(plan_module, "Processes", Here)
    monkeypatch.setattr(Here, "start", lambda *a: pytest.fail("trained again"))
    again = study_plan(
        options, out, config=short, iterations=4, seeds=2, alternatives=["no densification"], say=lambda text: None
    )
    assert again == records
    with pytest.raises(ValueError, match="other settings"):
        study_plan(options, out, config=dataclasses.replace(short, noise=0.1), iterations=4, say=lambda text: None)


def record(variant: str, seed: int, psnr: float) -> dict:
    """What the table needs of a training."""
    rest = dict.fromkeys(("ssim", "gaussians", "cpu_seconds", "peak_bytes"), 0.0) | {"ca": None}
    return {"variant": variant, "config": {"seed": seed}, "psnr": psnr, **rest}


def test_a_training_that_fails_is_reported_and_the_others_go_on(options, short, tmp_path, monkeypatch):
    """The one that the others of its seed are compared with, so that there is no difference to tell."""
    failing = ["as asked, seed 1"]

    def train(options, variant, config, device, threads):
        if f"{variant}, seed {config.seed}" in failing:
            raise MemoryError("no room")
        return record(variant, config.seed, 20.0) | {"config": dataclasses.asdict(config)}

    def study():
        said = []
        return study_plan(options, tmp_path, config=short, iterations=4, seeds=2, say=said.append), said

    monkeypatch.setattr(plan_module, "Processes", Here)
    monkeypatch.setattr(plan_module, "_train", train)
    with pytest.raises(RuntimeError, match=r"1 of 4 trainings failed \(as asked, seed 1\): .* tries them again"):
        study()
    stored = json.loads((tmp_path / "plan_study.json").read_text())
    assert [(r["variant"], r["config"]["seed"]) for r in stored["trainings"]] == [
        ("as asked", 0), ("SH bands", 0), ("SH bands", 1)
    ]  # fmt: skip
    assert stored["failures"]["as asked, seed 1"]["error"] == "MemoryError: no room"
    assert "in train" in stored["failures"]["as asked, seed 1"]["traceback"]
    assert "+0.00, n/a" in (tmp_path / "plan_study.md").read_text()

    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("seed_*.json")}
    failing.clear()
    records, said = study()
    assert [(r["variant"], r["config"]["seed"]) for r in records] == [
        (name, seed) for seed in (0, 1) for name in ("as asked", "SH bands")
    ]
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert "+0.00, +0.00" in said[-1]
    assert json.loads((tmp_path / "plan_study.json").read_text())["failures"] == {}


STUDY = """
from pathlib import Path
import sweep_tasks
from reference_trainer.scenes.options import SceneOptions
from benchmarks import plan
from reference_trainer.training.config import TrainConfig
plan._train = sweep_tasks.note_the_interruption_here
plan.study_plan(SceneOptions("synthetic", downscale=8.0), Path("out"), config=TrainConfig(iterations=1), seeds=1)
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_training_is_interrupted_however_the_study_ends(tmp_path, number):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])}
    study = subprocess.Popen(
        [sys.executable, "-c", STUDY], cwd=tmp_path, env=environment, start_new_session=True, stderr=subprocess.DEVNULL
    )
    until((tmp_path / "started").exists)
    study.send_signal(number)
    until((tmp_path / "interrupted").exists)
    study.wait(timeout=PATIENCE)


@pytest.mark.slow
def test_the_peak_of_a_training_is_its_own():
    """Every training has a fresh process, and what the parent has held does not count."""
    held = b"x" * (1 << 30)
    tasks = [Task("peak", plan_module._peak_bytes, ())]
    ((_, outcome),) = run_all(Processes(1), tasks)
    assert 2**24 < outcome.value < len(held)


def test_differences_are_taken_within_a_seed():
    rows = plan_table(
        [record("as asked", 0, 20.0), record("x", 0, 21.0), record("as asked", 1, 10.0), record("x", 1, 9.5)]
    ).splitlines()
    assert "+1.00, -0.50" in rows[3]
    assert "| 15.0 ± 7.1 |" in rows[2]


def test_more_work_takes_longer_and_the_model_stays(options):
    trainer = Trainer(options.load(), TrainConfig(iterations=1, sh_every=1))
    before = trainer.gaussians.map(lambda x: x.detach().clone())
    parts = parts_of_a_step(trainer, repeats=3)
    assert parts["step"] > 0
    assert parts["exact moments added"] > 0
    for (name, x), (_, y) in zip(before.named(), trainer.gaussians.named(), strict=True):
        assert x.equal(y), name
        assert y.grad is None, name
