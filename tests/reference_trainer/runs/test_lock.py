"""Locks held by real processes, killed for real."""

import errno
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock
from stand_ins.executor import Here

from reference_trainer.runs.compare import compare
from reference_trainer.runs.executors import Value
from reference_trainer.runs.folder import CHECKPOINT, LOCK, RESULTS, FolderInUseError, run_lock
from reference_trainer.runs.grid import Run, Running, run_grid
from reference_trainer.runs.measure import load_run_model
from reference_trainer.runs.run import Monitoring, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.training.trainer import Trainer

HOLD = """
import sys, time
from pathlib import Path
from reference_trainer.runs.folder import run_lock
with run_lock(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def elsewhere():
    """Start a process that locks a folder and sleeps."""
    started = []

    def lock(folder: Path) -> subprocess.Popen:
        process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout.readline() == "locked\n"
        return process

    yield lock
    for process in started:
        end(process)


def end(process: subprocess.Popen, number: int = signal.SIGKILL) -> None:
    """Send a signal to a process and wait until it has ended."""
    process.send_signal(number)
    process.wait(timeout=30)
    process.stdout.close()


def state(folder: Path) -> dict[Path, tuple[int, int]]:
    """When everything in a folder was written, and the folder itself."""
    paths = [folder, *folder.rglob("*")]
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in paths}


def test_a_folder_that_another_process_works_in_is_refused_untouched(tmp_path, elsewhere, options, short):
    (tmp_path / ".checkpoint.pt.1.part").write_bytes(b"being written")
    process = elsewhere(tmp_path)
    before = state(tmp_path)
    with pytest.raises(FolderInUseError) as refused:
        run_experiment(options, short, tmp_path)
    assert str(refused.value).startswith(f"{tmp_path}: ")
    assert f"(process {process.pid} on {socket.gethostname()}). Nothing was changed" in str(refused.value)
    assert state(tmp_path) == before


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_lock_ends_with_its_process_however_it_ends(tmp_path, elsewhere, number):
    end(elsewhere(tmp_path), number)
    with run_lock(tmp_path):
        assert f"process {os.getpid()} on " in (tmp_path / ".lock.holder").read_text()
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_a_second_run_of_the_same_process_is_refused_too(tmp_path):
    with run_lock(tmp_path):
        with pytest.raises(FolderInUseError, match=f"process {os.getpid()} on "), run_lock(tmp_path):
            pass
        with pytest.raises(FolderInUseError), run_lock(tmp_path):  # the first refusal has not released anything
            pass
    with run_lock(tmp_path):
        pass


@pytest.mark.parametrize("content", [b"", b"\x1b[2J process 1 on a", b"\xff", b"process 1 on a" * 10**5])
def test_a_holder_that_makes_no_sense_is_not_repeated(tmp_path, content):
    with run_lock(tmp_path):
        (tmp_path / ".lock.holder").write_bytes(content)
        with pytest.raises(FolderInUseError, match=r"work there \(.*not known\)"), run_lock(tmp_path):
            pass


def test_a_run_is_locked_from_its_first_file_to_its_last(tmp_path, options, short, monkeypatch):
    seen = []
    write, save = "reference_trainer.runs.run.write_json", Trainer.save

    def locked(original):
        def call(*args):
            with pytest.raises(FolderInUseError), run_lock(tmp_path):
                pass
            seen.append(original.__name__)
            return original(*args)

        return call

    from reference_trainer.evaluation.results import write_json

    monkeypatch.setattr(write, locked(write_json))
    monkeypatch.setattr(Trainer, "save", locked(save))
    run_experiment(options, short, tmp_path, monitoring=Monitoring(0))
    assert seen == ["write_json", "save", "save", "write_json"]  # settings, first and last checkpoint, results
    with run_lock(tmp_path):  # a complete run is read without the lock
        run_experiment(options, short, tmp_path, monitoring=Monitoring(0))


@pytest.mark.slow
def test_an_interrupted_run_leaves_its_lock_and_continues_with_it(tmp_path, options, short, ctrl_c, elsewhere, said):
    with ctrl_c(5):
        run_experiment(options, short, tmp_path, monitoring=Monitoring(0))
    process = elsewhere(tmp_path)
    before = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(FolderInUseError):
        run_experiment(options, short, tmp_path, monitoring=Monitoring(0))
    assert (tmp_path / CHECKPOINT).read_bytes() == before
    model, _ = load_run_model(tmp_path)  # who only reads is not kept out
    assert len(model.gaussians) > 0
    end(process)
    said.clear()
    run_experiment(options, short, tmp_path, monitoring=Monitoring(0))
    assert f"{tmp_path}: continues from step 6" in said


@pytest.mark.slow
def test_what_another_process_finished_while_the_scene_was_read_is_not_trained_again(
    tmp_path, options, short, monkeypatch
):
    scene, results = load_scene(options, seed=0), []

    def load(_, seed):
        with monkeypatch.context() as patch:
            patch.setattr("reference_trainer.runs.run.load_scene", lambda _, seed: scene)
            results.append(run_experiment(options, short, tmp_path, monitoring=Monitoring(0)))
        return scene

    monkeypatch.setattr("reference_trainer.runs.run.load_scene", load)

    def trained_again(trainer):
        pytest.fail("trained again")

    found = run_experiment(options, short, tmp_path, monitoring=Monitoring(0), on_step=trained_again)
    assert found == results[0]


@pytest.mark.slow
def test_a_sweep_goes_on_without_the_run_that_is_at_work_elsewhere(tmp_path, options, short, elsewhere):
    elsewhere(tmp_path / "a" / "seed_0")
    comparison = compare({tmp_path: options}, {"a": short}, [0, 1], Running(Here(), monitoring=Monitoring(0)))[tmp_path]
    assert [run["config"]["seed"] for run in comparison.runs["a"]] == [1]
    assert list(comparison.failures) == ["a, seed 0"]
    error = comparison.failures["a, seed 0"].error
    assert error.startswith(f"FolderInUseError: {tmp_path / 'a' / 'seed_0'}: ")
    assert not (tmp_path / "a" / "seed_0" / CHECKPOINT).exists()


@pytest.mark.slow
def test_what_another_sweep_finished_meanwhile_counts(tmp_path, options, short, said):
    class Other(Here):
        """The other sweep has the first run, and finishes it while the second is done here."""

        def start(self, number, task):
            if number == 0:
                with run_lock(tmp_path / "0"):
                    super().start(number, task)
            else:
                self.now = number, Value(run_experiment(options, short, tmp_path / "0", monitoring=Monitoring(0)))

    runs = [Run(str(i), options, short, tmp_path / str(i)) for i in range(2)]
    outcomes = run_grid(runs, Running(Other(), monitoring=Monitoring(0)))
    assert outcomes[0] == outcomes[1]
    assert (tmp_path / "0" / RESULTS).exists()
    assert any("FAILED, FolderInUseError" in line for line in said)
    assert said[-1].startswith("[2/2] 0: ")
    assert said[-1].endswith(" dB, finished meanwhile")


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_file_system_without_locks_is_used_with_a_warning(tmp_path, monkeypatch, code):
    fcntl = pytest.importorskip("fcntl")

    def flock(fd, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", flock)
    for _ in range(2):  # nothing is left behind that would refuse the next run
        with pytest.warns(RuntimeWarning, match=r"without locks \("), run_lock(tmp_path):
            pass


def test_other_errors_are_not_taken_for_missing_locks(tmp_path, monkeypatch):
    def acquire(self, **keywords):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / LOCK))

    monkeypatch.setattr(FileLock, "acquire", acquire)
    with pytest.raises(OSError, match=r"No space left.*\.lock"), run_lock(tmp_path):
        pass
