import dataclasses
import math
from functools import partial

import pytest
from stand_ins.executor import Here

from benchmarks import plan as plan_module
from benchmarks.plan import ALTERNATIVES, parts_of_a_step, plan_study, plan_table, shortened, variants
from reference_trainer.runs.executors import Processes, Task, run_all
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.study import run_study
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


@pytest.fixture(scope="module")
def options():
    return SceneOptions("synthetic", downscale=8)


@pytest.fixture(scope="module")
def short():
    return TrainConfig(
        iterations=11, dropout=0.2, noise=0.3, sh_every=4, densify_from=2, densify_every=4, densify_gradient=2e-3
    )


def test_every_changing_item_is_tried_alone_and_with_the_others():
    tried = variants(TWO, TrainConfig(), ["initial size 1/2", "SH degree 1"])
    assert list(tried) == ["as asked", "bands", "size", "the whole plan", "SH degree 1"]  # 1/2 is there as "size"
    assert tried["bands"] == TrainConfig(sh_degree=0)
    assert tried["the whole plan"] == TrainConfig(sh_degree=0, initial_scale=0.5)


def test_an_unknown_alternative_names_the_known_ones():
    with pytest.raises(ValueError, match=r"alternatives \['no sun'\]; .*SH degree 0"):
        variants(TWO, TrainConfig(), ["no sun"])


def test_the_help_names_the_alternatives():
    assert all(f'"{name}"' in plan_module.plan.__doc__ for name in ALTERNATIVES)


def test_a_shortened_schedule_keeps_its_proportions():
    config = shortened(TrainConfig(iterations=3_000), 300)
    assert (config.iterations, config.sh_every, config.densify_from, config.opacity_reset_from) == (300, 50, 50, 200)
    assert shortened(TrainConfig(iterations=500), 500) == TrainConfig(iterations=500)


@pytest.mark.slow
def test_the_study_trains_what_it_says(tmp_path, options, short):
    study = plan_study(options, config=short, iterations=4, seeds=2, alternatives=["no densification"])
    records = [*run_study(study, tmp_path, executor=Here()).values()]
    assert [(record["variant"], record["config"]["seed"]) for record in records] == [
        (name, seed) for seed in (0, 1) for name in ("as asked", "SH bands", "no densification")
    ]
    assert [record["config"]["sh_degree"] for record in records] == [3, 2, 3] * 2
    assert [record["config"]["densify_every"] for record in records] == [4, 4, 0] * 2
    assert all(record["cpu_seconds"] > 0 and record["peak_bytes"] > 2**20 for record in records)
    assert [record["parts"] is not None for record in records] == [True] + [False] * 5
    assert (tmp_path / "plan_study.md").read_text() == plan_table(records)


def record(variant: str, seed: int, psnr: float) -> dict:
    """What the table needs of a training."""
    rest = dict.fromkeys(("ssim", "gaussians", "cpu_seconds", "peak_bytes"), 0.0) | {"ca": math.nan}
    return {"variant": variant, "config": {"seed": seed}, "psnr": psnr, **rest}


def test_a_training_that_fails_is_reported_and_the_others_go_on(options, short, tmp_path):
    """The one that the others of its seed are compared with, so that there is no difference to tell."""
    failing = ["as asked, seed 1"]

    def train(options, variant, config, device, threads):
        if f"{variant}, seed {config.seed}" in failing:
            raise MemoryError("no room")
        return record(variant, config.seed, 20.0)

    def trained():
        study = dataclasses.replace(plan_study(options, config=short, iterations=4, seeds=2), measure=train)
        run_study(study, tmp_path, executor=Here())

    with pytest.raises(RuntimeError, match=r"1 of 4 .*FAILED; .*\n  as asked, seed 1: MemoryError"):
        trained()
    assert "+0.00, n/a" in (tmp_path / "plan_study.md").read_text()
    failing.clear()
    trained()
    assert "+0.00, +0.00" in (tmp_path / "plan_study.md").read_text()


@pytest.mark.slow
def test_the_peak_of_a_training_is_its_own(options, short):
    """Every training has a fresh process, and what the parent has held does not count."""
    held = b"x" * (1 << 30)
    study = plan_study(options, config=short, iterations=4, seeds=1)
    tasks = [Task("peak", partial(study.measure, **next(iter(study.cases.values()))), ())]
    ((_, outcome),) = run_all(Processes(1), tasks)
    assert 2**24 < outcome.value["peak_bytes"] < len(held)


def test_differences_are_taken_within_a_seed():
    rows = plan_table(
        [record("as asked", 0, 20.0), record("x", 0, 21.0), record("as asked", 1, 10.0), record("x", 1, 9.5)]
    ).splitlines()
    assert "+1.00, -0.50" in rows[3]
    assert "| 15.0 ± 7.1 |" in rows[2]


def test_more_work_takes_longer_and_the_model_stays(options):
    trainer = Trainer(load_scene(options), TrainConfig(iterations=1, sh_every=1))
    before = trainer.gaussians.map(lambda x: x.detach().clone())
    parts = parts_of_a_step(trainer, repeats=3)
    assert parts["step"] > 0
    assert parts["exact moments added"] > 0
    for (name, x), (_, y) in zip(before.named(), trainer.gaussians.named(), strict=True):
        assert x.equal(y), name
        assert y.grad is None, name
