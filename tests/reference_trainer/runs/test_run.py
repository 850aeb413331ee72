import dataclasses
import json
import shutil
import signal
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from ca_reg.monitor import LOG_NAME
from reference_trainer.evaluation.tables import evaluation_table, summary
from reference_trainer.model.ply import load_ply
from reference_trainer.runs import run as run_module
from reference_trainer.runs.folder import BAKED_PLY, CHECKPOINT, COMPARISON, CONFIG, PLAN, PLY, RESULTS, read_results
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, load_run, model_of, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingInterrupted, TrainingStoppedError
from reference_trainer.training.plan import Plan
from reference_trainer.training.trainer import Trainer

EVERY: dict[str, Any] = {"monitoring": Monitoring(3, checkpoint_every=4)}
WHOLE = {
    "config": {"seed": 0},
    "gaussians": 1,
    "seconds": 1.0,
    "mean": {"train": {}},
    "views": [{"name": "a", "split": "train"}],
}
DAMAGED = ("[]", '{"mean": {}}', *(json.dumps(WHOLE | change) for change in (
    {"mean": {}}, {"mean": {"train": {"psnr": "x"}}}, {"views": []}, {"views": [{"name": "a"}]}, {"gaussians": 10**99},
    {"config": {}}, {"seconds": None},
)))  # fmt: skip


@pytest.fixture
def interrupted(finished, options, short, monkeypatch, tmp_path):
    """Start a run that is interrupted in the given function at its given call, then continue it."""

    def run(owner: object, name: str, call: int, **keywords) -> Path:
        original, calls = getattr(owner, name), [0]

        def interrupt(*args, **kwargs):
            calls[0] += 1
            if calls[0] == call:
                raise KeyboardInterrupt
            return original(*args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, interrupt)
            with pytest.raises(KeyboardInterrupt):
                run_experiment(options, short, tmp_path, **EVERY | keywords)
        assert not (tmp_path / RESULTS).exists()
        run_experiment(options, short, tmp_path, **EVERY | keywords)
        return tmp_path

    return run


def test_everything_is_there(finished, options, short):
    out, results = finished
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    names = [f"train/train_{i}" for i in range(3)] + ["test/test_0", "test/test_1", "test/test_outside"]
    pictures = {f"views/{name}{end}.png" for name in names for end in ("", "_panel")}
    assert {CONFIG, CHECKPOINT, PLY, BAKED_PLY, RESULTS, LOG_NAME} | pictures <= files
    assert any("tfevents" in name for name in files)
    assert not [name for name in files if ".part" in name]
    assert json.loads((out / CONFIG).read_text()) == {
        "scene": dataclasses.asdict(options),
        "config": dataclasses.asdict(short),
    }
    assert results == json.loads((out / RESULTS).read_text())
    assert results["gaussians"] == len(load_ply(out / PLY).gaussians) > 3000
    assert [view["name"] for view in results["views"]] == [name.split("/")[1] for name in names]
    assert results["mean"]["test"]["lpips"] is None
    assert [json.loads(line)["step"] for line in (out / LOG_NAME).read_text().splitlines()] == [3, 6, 9, 11]


def test_a_second_call_does_nothing(finished, options, short, monkeypatch, said):
    out, results = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    monkeypatch.setattr("reference_trainer.runs.run.load_scene", lambda *_, **__: pytest.fail("it was loaded again"))
    assert run_experiment(options, short, out, **EVERY) == results
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    assert said == [f"{out}: complete, nothing to do"]


def test_a_complete_run_says_that_it_lacks_the_metric_that_is_asked_for(finished, options, short, monkeypatch, said):
    metric = SimpleNamespace(name="lpips-alex")
    monkeypatch.setattr("reference_trainer.runs.run.load_lpips", lambda *_, **__: metric)
    run_experiment(options, short, finished[0], lpips="weights.pth", **EVERY)
    assert said[-1].startswith(f"{finished[0]} was measured without lpips-alex: ca-reg evaluate")
    assert "--lpips" in said[-1]


def test_ctrl_c_saves_where_it_is(finished, options, short, ctrl_c, tmp_path, said):
    """Between two periodic checkpoints nothing is lost."""
    with ctrl_c(5):
        run_experiment(options, short, tmp_path, **EVERY)
    load_run_model(tmp_path)  # for its scores or pictures, which are of a model in the middle of its training
    assert said[-1].startswith(f"{tmp_path} is not trained")
    assert said[-1].endswith("step 6 of 11")
    run_experiment(options, short, tmp_path, **EVERY)
    assert f"{tmp_path}: continues from step 6" in said
    assert (tmp_path / PLY).read_bytes() == (finished[0] / PLY).read_bytes()


@pytest.mark.slow
def test_sigterm_saves_and_then_ends_the_process_as_its_sender_expects(
    finished, options, short, monkeypatch, tmp_path, said
):
    original, received = Trainer.train_step, []

    def train_step(trainer: Trainer) -> float:
        if trainer.step == 5:
            signal.raise_signal(signal.SIGTERM)
        return original(trainer)

    before = signal.signal(signal.SIGTERM, lambda number, frame: received.append(load_run(tmp_path).step))
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "train_step", train_step)
            with pytest.raises(TrainingInterrupted):
                run_experiment(options, short, tmp_path, **EVERY)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert received == [6]  # raised again, when the model had been saved
    assert said[-1].startswith(f"{tmp_path}: saved at step 6 of 11")
    run_experiment(options, short, tmp_path, **EVERY)
    assert (tmp_path / PLY).read_bytes() == (finished[0] / PLY).read_bytes()


@pytest.mark.slow
def test_a_full_disk_keeps_the_last_checkpoint(finished, options, short, monkeypatch, tmp_path, full_disk):
    original = Trainer.save

    def save(trainer: Trainer, path: Path) -> None:
        with full_disk(100_000) if trainer.step > 4 else nullcontext():
            original(trainer, path)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "save", save)
        with pytest.raises(OSError, match=r"before is kept.*checkpoint\.pt"):
            run_experiment(options, short, tmp_path, **EVERY)
    assert load_run(tmp_path).step == 4
    assert not list(tmp_path.rglob("*.part"))
    run_experiment(options, short, tmp_path, **EVERY)
    assert (tmp_path / PLY).read_bytes() == (finished[0] / PLY).read_bytes()


@pytest.mark.slow
def test_leftovers_of_a_killed_run_are_removed(finished, options, short, tmp_path):
    """The run was killed while it measured: everything is there but its results, and half of a picture."""
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    (out / RESULTS).unlink()
    leftover = out / "views" / "train" / ".train_0.png.1234.part"
    leftover.write_bytes(b"half")
    run_experiment(options, short, out, **EVERY)
    assert not leftover.exists()


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        (CONFIG, "{", r"config\.json is not valid JSON"),
        (CONFIG, "{}", r"config\.json is not the config\.json of a run"),
        (CONFIG, '{"scene": {}, "config": {"dropout": "much"}}', r"config\.json, config: dropout .*float, got"),
        *((RESULTS, content, r"results\.json does not hold the results of a run") for content in DAMAGED),
    ],
)
def test_damaged_files_are_named(finished, options, short, tmp_path, file, content, said):
    shutil.copytree(finished[0], tmp_path / "run")
    (tmp_path / "run" / file).write_text(content)
    with pytest.raises(ValueError, match=said):
        run_experiment(options, short, tmp_path / "run", **EVERY)
    if file == CONFIG:
        with pytest.raises(ValueError, match=said):
            load_run(tmp_path / "run")


def test_results_of_a_version_without_a_score_are_read_and_shown(tmp_path):
    (tmp_path / RESULTS).write_text(json.dumps(WHOLE))
    results = read_results(tmp_path)
    assert results == WHOLE
    assert "| train | n/a |" in summary(results)
    assert "| mean train | n/a |" in evaluation_table(results)


def test_a_checkpoint_whose_settings_are_gone_is_not_continued_with_others(options, short, tmp_path, finished):
    shutil.copy(finished[0] / CHECKPOINT, tmp_path)
    with pytest.raises(ValueError, match=r"checkpoint\.pt but no config\.json"):
        run_experiment(options, dataclasses.replace(short, dropout=0.5), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]


def with_changes(changes):
    return {"items": [{"name": "SH bands", "decision": "reduced", "reason": "none", "changes": changes}]}


@pytest.mark.parametrize(
    ("plan", "error"),
    [
        ([], "expected a plan"),
        (with_changes({"no_setting": 0}), "no_setting"),  # of another version
        (with_changes({"initial_scale": "half"}), "initial_scale must be a number"),
        (with_changes(3), "int"),
    ],
)
def test_a_damaged_plan_is_named(options, short, tmp_path, plan, error):
    (tmp_path / CONFIG).write_text('{"scene": {}, "config": {}}')
    (tmp_path / PLAN).write_text(json.dumps(plan))
    with pytest.raises(ValueError, match=rf"plan\.json: .*{error}"):
        run_experiment(options, short, tmp_path, auto=True)


@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [
        pytest.param(Trainer, "train_step", 1, marks=pytest.mark.slow),
        (Trainer, "train_step", 6),
        pytest.param(Trainer, "train_step", 8, marks=pytest.mark.slow),
        pytest.param(run_module, "view_psnr", 2, marks=pytest.mark.slow),  # in the middle of a measurement
        pytest.param(run_module, "save_ply", 1, marks=pytest.mark.slow),
        pytest.param(run_module, "evaluate", 1, marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_run_ends_like_an_uninterrupted_one(finished, interrupted, owner, name, call):
    out = interrupted(owner, name, call)
    for file in (PLY, BAKED_PLY, LOG_NAME):
        assert (out / file).read_bytes() == (finished[0] / file).read_bytes(), file
    one, other = (json.loads((folder / RESULTS).read_text()) for folder in (out, finished[0]))
    for key in ("views", "mean", "gaussians", "config"):
        assert one[key] == other[key]


def test_a_killed_run_continues_from_its_last_checkpoint(finished, options, short, tmp_path, said):
    """No farewell: the checkpoint of step 4, and a log that is already further, with half a line at its end."""
    partial = Trainer(load_scene(options, seed=0), short)
    partial.train(until=4)
    partial.save(tmp_path / CHECKPOINT)
    shutil.copy(finished[0] / CONFIG, tmp_path)
    shutil.copy(finished[0] / LOG_NAME, tmp_path)
    with (tmp_path / LOG_NAME).open("a") as log:
        log.write('{"step": 12, "ca')
    run_experiment(options, short, tmp_path, **EVERY)
    assert f"{tmp_path}: continues from step 4" in said
    for file in (PLY, LOG_NAME):
        assert (tmp_path / file).read_bytes() == (finished[0] / file).read_bytes(), file


def test_monitoring_has_no_influence(finished, options, short, tmp_path):
    run_experiment(options, short, tmp_path, monitoring=Monitoring(0, checkpoint_every=4))
    assert not (tmp_path / LOG_NAME).exists()
    assert (tmp_path / PLY).read_bytes() == (finished[0] / PLY).read_bytes()


def test_tensorboard_shows_pictures_of_a_view_of_each_split_if_asked_to(finished, scaled):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    shown = {}
    for out in (finished[0], scaled[0]):
        shown[out] = accumulator.EventAccumulator(str(out))
        shown[out].Reload()
    pictures = ("render", "error", "expected error", "co-adaptation")
    tags = {f"{what}/{split}" for what in pictures for split in ("train", "test")}
    assert set(shown[finished[0]].Tags()["images"]) == tags
    for tag in tags:
        images = shown[finished[0]].Images(tag)
        assert [(image.step, image.width, image.height) for image in images] == [
            (step, 20, 15) for step in (3, 6, 9, 11)
        ]
    assert not shown[scaled[0]].Tags()["images"]
    assert {"loss", "learning rate/means", "dropout rate", "psnr/test"} <= set(shown[finished[0]].Tags()["scalars"])
    assert any(tag.startswith("settings") for tag in shown[finished[0]].Tags()["tensors"])


def test_the_log_and_tensorboard_hold_the_score_of_the_tables(finished):
    """The exact score at drop rate 1/2, although the training drops: what results.json calls ca_exact_half."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    out, results = finished
    last = json.loads((out / LOG_NAME).read_text().splitlines()[-1])
    expected = results["mean"]["test"]["ca_exact_half"]
    assert (last["method"], last["drop_rate"]) == ("exact", 0.5)
    assert last["ca/test"] == pytest.approx(expected, rel=1e-6)
    shown = accumulator.EventAccumulator(str(out))
    shown.Reload()
    assert shown.Scalars("exact CA (1e-3)/test")[-1].value == pytest.approx(1e3 * expected, rel=1e-5)
    assert "ca/test" not in shown.Tags()["scalars"]
    assert f"| {1e3 * expected:.2f} |" in summary(results)
    assert results["ca_settings"]["drop_rate"] == pytest.approx(0.6)
    assert "CA (5 renders, drop rate 0.6) (1e-3)" in evaluation_table(results)


@pytest.mark.parametrize("name", [PLY, RESULTS, COMPARISON, "views"])
def test_a_folder_of_somebody_elses_is_not_written_to(name, options, short, tmp_path):
    (tmp_path / name).mkdir() if name == "views" else (tmp_path / name).write_text("precious")
    if name == RESULTS:  # without the settings of a run it is nobody's
        (tmp_path / BAKED_PLY).write_text("precious")
    before = {path: path.read_text() for path in tmp_path.iterdir() if path.is_file()}
    with pytest.raises(ValueError, match=f"holds .*{name}.* give another --out"):
        run_experiment(options, short, tmp_path)
    assert {path: path.read_text() for path in tmp_path.iterdir() if path.is_file()} == before


def test_the_folder_of_the_scene_is_not_written_to(short, tmp_path):
    with pytest.raises(ValueError, match="folder of the scene"):
        run_experiment(SceneOptions(str(tmp_path)), short, tmp_path)


def test_another_run_in_the_same_folder_is_refused(finished, options, short):
    out, results = finished
    with pytest.raises(ValueError, match=r"settings \(dropout: 0\.2 -> 0\.5\)"):
        run_experiment(options, dataclasses.replace(short, dropout=0.5), out)
    with pytest.raises(ValueError, match=r"\(views: None -> 2; seed: 0 -> 3\)"):
        run_experiment(dataclasses.replace(options, views=2), dataclasses.replace(short, seed=3), out)
    assert json.loads((out / RESULTS).read_text()) == results


def test_settings_that_were_changed_in_the_file_are_not_taken_for_those_of_the_training(
    finished, options, short, tmp_path
):
    """The training would go on with its own, and a report would show the others."""
    shutil.copytree(finished[0], tmp_path / "run")
    (tmp_path / "run" / RESULTS).unlink()
    file = tmp_path / "run" / CONFIG
    file.write_text(file.read_text().replace('"dropout": 0.2', '"dropout": 0.5'))
    for use in (load_run, lambda out: run_experiment(options, dataclasses.replace(short, dropout=0.5), out)):
        with pytest.raises(ValueError, match=r"config\.json .*dropout: 0\.2 -> 0\.5"):
            use(tmp_path / "run")


def test_a_run_of_a_version_without_a_setting_was_at_its_default(finished, options, short, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    file = tmp_path / "run" / CONFIG
    claim = json.loads(file.read_text())
    del claim["config"]["density"]
    file.write_text(json.dumps(claim))
    assert run_experiment(options, short, tmp_path / "run", **EVERY) == finished[1]
    with pytest.raises(ValueError, match=r"analytic: False -> True; loss: photometric -> photometric\(0\.1\)"):
        run_experiment(options, dataclasses.replace(short, analytic=True, loss="photometric(0.1)"), tmp_path / "run")


def test_a_mistyped_scene_does_not_claim_the_folder(options, short, tmp_path):
    with pytest.raises(FileNotFoundError, match="no scene folder"):
        run_experiment(SceneOptions(str(tmp_path / "fren")), short, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def broken_scene(options: SceneOptions, monkeypatch) -> None:
    """Give one training view a pixel that is not a number."""
    scene = load_scene(options)
    image = scene.train[1].image.clone()
    image[0, 0, 0] = torch.nan
    bad = dataclasses.replace(scene.train[1], image=image)
    scene = dataclasses.replace(scene, train=(scene.train[0], bad, scene.train[2]))
    monkeypatch.setattr("reference_trainer.runs.run.load_scene", lambda _, seed: scene)


def test_divergence_keeps_the_last_checkpoint(options, short, monkeypatch, tmp_path):
    broken_scene(options, monkeypatch)
    for _ in range(2):  # the second call fails in the same way and does no harm
        with pytest.raises(TrainingStoppedError, match="loss became nan"):
            run_experiment(options, short, tmp_path, monitoring=Monitoring(0, checkpoint_every=1))
        trainer = load_run(tmp_path)
        assert 0 < trainer.step < 3
        assert all(torch.isfinite(x).all() for _, x in trainer.gaussians.named())
        reference = Trainer(trainer.scene, short)
        reference.train(until=trainer.step)
        assert torch.equal(trainer.gaussians.means, reference.gaussians.means)
        assert not (tmp_path / RESULTS).exists()


@pytest.mark.slow
def test_a_model_that_vanishes_does_not_overwrite_the_checkpoint(options, short, tmp_path):
    config = dataclasses.replace(short, prune_opacity=0.99)
    for _ in range(2):
        with pytest.raises(TrainingStoppedError, match=r"pruned .*step 4: .*step 3 .*\.pt"):
            run_experiment(options, config, tmp_path, monitoring=Monitoring(0, checkpoint_every=3))
        trainer = load_run(tmp_path)
        assert (trainer.step, len(trainer.gaussians)) == (3, 3000)


def test_a_run_can_be_loaded(finished):
    out, results = finished
    trainer = load_run(out)
    assert trainer.step == 11
    model = model_of(trainer)
    assert (model.dropout, model.factor, model.sh_degree) == (pytest.approx(0.2), pytest.approx(0.8), 2)
    assert not model.gaussians.means.requires_grad
    assert len(model.gaussians) == results["gaussians"]


def test_a_run_whose_scene_has_moved_says_how_it_is_found_again(finished, tmp_path):
    """Two files are the run: the settings, with the place of the scene, and the checkpoint."""
    for name in (CONFIG, CHECKPOINT):
        shutil.copy(finished[0] / name, tmp_path)
    settings = json.loads((tmp_path / CONFIG).read_text())
    before, settings["scene"]["path"] = settings["scene"]["path"], str(tmp_path / "gone")
    (tmp_path / CONFIG).write_text(json.dumps(settings))
    with pytest.raises(FileNotFoundError, match=r'gone, .*not there.*"path" .*config\.json'):
        load_run(tmp_path)
    settings["scene"]["path"] = before
    (tmp_path / CONFIG).write_text(json.dumps(settings))
    assert load_run(tmp_path).step == 11


def test_inverted_dropout_needs_nothing_at_test_time(tiny_scene):
    model = model_of(Trainer(tiny_scene, TrainConfig(regularizer="dropout(0.2, compensate=True)")))
    assert (model.dropout, model.factor) == (0.0, 1.0)


def test_a_folder_without_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no config\.json\): .*--out"):
        load_run(tmp_path)


def test_summary(finished):
    lines = summary(finished[1]).splitlines()
    assert [line.split("|")[1].strip() for line in lines] == ["views", ":---", "test", "train"]
    psnr = finished[1]["mean"]["test"]["psnr"]
    assert f"| {psnr:.2f} |" in lines[2]
    assert "LPIPS" not in lines[0]  # no perceptual metric


def test_a_run_says_what_is_recommended_and_not_done(options, short, tmp_path, said):
    run_experiment(options, dataclasses.replace(short, iterations=1, dropout=0.0), tmp_path, auto=True)
    assert any(line.startswith("plan: dropout recommended: ") for line in said)


def test_auto_trains_by_the_plan_and_keeps_it(options, short, tmp_path, said):
    results = run_experiment(options, short, tmp_path, **EVERY, auto=True)
    stored = Plan.from_dict(json.loads((tmp_path / PLAN).read_text()))
    assert stored.applied(short) == dataclasses.replace(short, sh_degree=2)
    assert results["config"] == json.loads((tmp_path / CONFIG).read_text())["config"]
    assert results["config"]["sh_degree"] == 2
    assert load_run(tmp_path).gaussians.sh_degree == 2
    assert any(line.startswith("plan: SH bands reduced (sh_degree=2): ") for line in said)

    with pytest.raises(ValueError, match=r"sh_degree: 2 -> 3"):
        run_experiment(options, short, tmp_path, **EVERY)
    with pytest.raises(ValueError, match=r"sh_degree: 2 -> 3"):
        run_experiment(options, short, tmp_path, **EVERY, auto=True, given=["sh_degree"])


@pytest.mark.slow
def test_an_interrupted_run_continues_with_its_own_plan(options, short, monkeypatch, tmp_path):
    """Even if the rules have changed since."""
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "evaluate", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run_experiment(options, short, tmp_path, **EVERY, auto=True)
    monkeypatch.setattr(run_module, "make_plan", lambda *a, **k: pytest.fail("planned again"))
    assert run_experiment(options, short, tmp_path, **EVERY, auto=True)["config"]["sh_degree"] == 2


def test_a_run_that_began_without_a_plan_goes_on_without(finished, options, short):
    out, results = finished
    assert not (out / PLAN).exists()
    assert run_experiment(options, short, out, **EVERY, auto=True) == results


@pytest.mark.slow
def test_what_is_given_is_trained(options, short, tmp_path):
    assert run_experiment(options, short, tmp_path, **EVERY, auto=True, given=["sh_degree"])["config"]["sh_degree"] == 3


def test_a_training_that_stops_at_once_leaves_the_model_that_it_began_with(options, short, tmp_path):
    config = dataclasses.replace(short, scales_rate=1e9, densify_every=0)
    with pytest.raises(TrainingStoppedError, match=r"step 2 .*rendered: .*step 0 .*kept"):
        run_experiment(options, config, tmp_path, **EVERY)
    assert load_run(tmp_path).step == 0
