"""What runs every study: records on the disk, what of them is used again, and what is written of all."""

import itertools
import json
import math
import os
from pathlib import Path

import pytest
from PIL import Image
from stand_ins.executor import Here

from reference_trainer.runs.folder import CHECKPOINT, FolderInUseError, run_lock
from reference_trainer.studies import study as study_module
from reference_trainer.studies.study import Study, checkpoints, in_turns, run_study

measured: list[str] = []


def measure(text, times=1, source=None):
    if times < 0:
        raise ValueError(f"no {times} times")
    measured.append(text)
    return {"text": text * times, "length": math.nan if times == 0 else float(times), "pair": (1, 2)}


def report(records):
    return "\n".join(f"{name}: {record['text']}" for name, record in records.items()) + "\n"


def plot(records, figure):
    figure.set_size_inches(2, 1)
    figure.add_subplot().plot(range(len(records)))


def study(check=False, **cases):
    return Study("letters", measure, cases, report, plot, check)


@pytest.fixture(autouse=True)
def _nothing_measured():
    measured.clear()


def test_a_study_leaves_numbers_tables_and_a_figure(tmp_path, said):
    records = run_study(study(a={"text": "x", "times": 3}, b={"text": "y", "times": 0}), tmp_path)
    assert list(records) == ["a", "b"]
    assert records["a"] == {"text": "xxx", "length": 3.0, "pair": [1, 2]}  # as it is read from JSON
    assert math.isnan(records["b"]["length"])
    data = json.loads((tmp_path / "letters.json").read_text())
    assert (data["study"], data["cases"]["a"], data["cases"]["b"]["length"]) == ("letters", records["a"], None)
    assert "torch" in data["machine"]
    assert (tmp_path / "letters.md").read_text() == "a: xxx\nb: \n"
    assert said[:3] == ["[1/2] a", "[2/2] b", "a: xxx\nb: \n"]
    with Image.open(tmp_path / "letters.png") as picture:
        assert picture.width == 2 * picture.height  # as the study's figure is


def test_cases_come_and_go_and_only_new_ones_are_measured(tmp_path, said):
    first = run_study(study(a={"text": "x", "times": 0}), tmp_path)
    again = run_study(study(b={"text": "y"}, a={"text": "x", "times": 0}), tmp_path)
    assert measured == ["x", "y"]
    assert list(again) == ["b", "a"]
    assert math.isnan(again["a"]["length"])
    assert repr(again["a"]) == repr(first["a"])
    assert any(message.startswith("1 measured before, kept: ") for message in said)
    run_study(study(a={"text": "x", "times": 2}), tmp_path)
    run_study(study(a={"text": "x", "times": 0}), tmp_path)
    assert measured == ["x", "y", "x"]  # the settings of either call were measured once


def test_another_file_or_machine_is_measured_again(tmp_path, monkeypatch):
    source = tmp_path / "source"
    source.write_text("1")
    asked = study(a={"text": "x", "source": source})
    for _ in range(2):
        run_study(asked, tmp_path / "out")
    assert len(measured) == 1
    later = source.stat().st_mtime_ns + 1_000_000_000
    os.utime(source, ns=(later, later))
    run_study(asked, tmp_path / "out")
    assert len(measured) == 2
    monkeypatch.setattr(study_module, "machine", lambda: {"cpu": "another"})
    run_study(asked, tmp_path / "out")
    assert len(measured) == 3


def test_an_interrupted_study_continues_and_writes_nothing_of_all(tmp_path):
    cases = {"a": {"text": "x"}, "b": {"text": "y", "times": -1}}
    for _ in range(2):
        with pytest.raises(ValueError, match="no -1 times"):
            run_study(study(**cases), tmp_path)
    assert measured == ["x"]
    assert [path.name for path in tmp_path.glob("letters.*")] == ["letters.records.json"]


def test_a_check_continues_where_it_was_interrupted_and_begins_anew_when_it_is_finished(tmp_path):
    with pytest.raises(ValueError, match="no -1 times"):
        run_study(study(True, a={"text": "x"}, b={"text": "y", "times": -1}), tmp_path)
    for _ in range(2):
        run_study(study(True, a={"text": "x"}), tmp_path)
    assert measured == ["x", "x"]


def test_on_an_executor_a_failing_case_does_not_stop_the_others(tmp_path, said):
    cases = {"a": {"text": "x", "times": -1}, "b": {"text": "y"}}
    with pytest.raises(RuntimeError, match=r"1 of 2 .*FAILED; .*:\n  a: ValueError: no -1"):
        run_study(study(**cases), tmp_path, executor=Here(1))
    assert said[:3] == ["[1/2] a: FAILED", "[2/2] b", "b: y\n"]
    assert json.loads((tmp_path / "letters.json").read_text())["failed"] == {"a": "ValueError: no -1 times"}
    records = run_study(study(**cases | {"a": {"text": "z"}}), tmp_path, executor=Here(1))
    assert measured == ["y", "z"]
    assert [record["text"] for record in records.values()] == ["z", "y"]


def test_no_case_is_no_study(tmp_path):
    with pytest.raises(ValueError, match="1 case of letters"):
        run_study(study(), tmp_path)


def test_checkpoints_are_named_by_the_last_parts_of_their_paths_that_tell_them_apart(tmp_path):
    runs = [tmp_path / "fern" / "dropout" / f"seed_{i}" for i in range(2)]
    for run in runs:
        run.mkdir(parents=True)
        (run / CHECKPOINT).touch()
    named = {f"fern/dropout/seed_{i}": run.resolve() / CHECKPOINT for i, run in enumerate(runs)}
    assert checkpoints([*runs, runs[0]]) == named
    with pytest.raises(ValueError, match="at least 1 run"):
        checkpoints([])
    with pytest.raises(FileNotFoundError, match="holds no run"):
        checkpoints([tmp_path])
    other = Path(tmp_path, "other", "fern", "dropout", "seed_0")
    other.mkdir(parents=True)
    (other / CHECKPOINT).touch()
    assert [*checkpoints([runs[0], other])] == [f"{tmp_path.name}/fern/dropout/seed_0", "other/fern/dropout/seed_0"]


def test_a_folder_where_another_study_is_at_work_is_left_alone(tmp_path):
    with run_lock(tmp_path):
        before = sorted(tmp_path.iterdir())
        with pytest.raises(FolderInUseError, match="at work there"):
            run_study(study(a={"text": "x"}), tmp_path)
        assert (measured, sorted(tmp_path.iterdir())) == ([], before)
    run_study(study(a={"text": "x"}), tmp_path)
    assert measured == ["x"]


def test_calls_are_made_in_turns_and_the_first_round_is_not_timed():
    made = []
    calls = {name: lambda name=name: made.append(name) for name in "ab"}
    assert in_turns(calls, 3, itertools.count().__next__) == {"a": [1] * 3, "b": [1] * 3}
    assert made == ["a", "b"] * 4
