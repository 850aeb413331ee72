"""What the workers of the sweep tests do; they find it by module and name, as any task.

Only what needs torch imports it: a worker that has nothing else to do starts in a tenth of the time.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from reference_trainer.runs.folder import CHECKPOINT, RESULTS


def square(number):
    """Return the square, or raise for 3."""
    if number == 3:
        raise ValueError("three is refused")
    return number * number


def environment():
    """Return the process and its threads."""
    import torch

    return os.getpid(), torch.get_num_threads()


def wait_to_be_killed(folder, number):
    """The first time, leave the number of the process and sleep; the next time, return."""
    file = Path(folder, "pid")
    if not file.exists():
        file.with_suffix(".part").write_text(str(os.getpid()))
        file.with_suffix(".part").rename(file)
        time.sleep(60)
    return number * number


def leave():
    """End the process as a library might."""
    os._exit(7)


def note_the_interruption(folder):
    """Sleep, and leave a note when interrupted."""
    part = Path(folder, "started.part")
    part.write_text(str(os.getpid()))
    part.rename(Path(folder, "started"))
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        Path(folder, "interrupted").touch()
        raise


def train_and_be_killed_once(options, config, out, *rest):
    """A run whose first worker is killed as soon as there is a checkpoint."""
    marker = out / "killed"
    if not marker.exists():
        threading.Thread(target=_kill_at_checkpoint, args=(out, marker), daemon=True).start()
    from reference_trainer.runs.grid import train_run  # of this process; the test's has this function in its place

    return train_run(options, config, out, *rest)


def _kill_at_checkpoint(out, marker):
    while not (out / CHECKPOINT).exists():
        time.sleep(0.001)
    assert not (out / RESULTS).exists()
    marker.touch()
    os.kill(os.getpid(), signal.SIGKILL)


def interrupted_sweep(folder):
    """A whole sweep of one task, for a process of its own that is to be ended from outside."""
    from reference_trainer.runs.executors import Processes, Task, run_all

    list(run_all(Processes(1), [Task("sleeper", note_the_interruption, (folder,))]))


if __name__ == "__main__":
    interrupted_sweep(sys.argv[1])
