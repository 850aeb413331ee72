"""Peak memory of a rendering above its inputs."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from unittest import mock

import torch

from benchmarks.calls import gradients, image, render_with
from benchmarks.workloads import WorkloadSpec
from reference_trainer.runs.executors import Failure, Processes, Task, run_all

__all__ = ["PROCESS", "peak_memory", "process_status"]

PROCESS = Path("/proc/self")
_TINY = WorkloadSpec(100, 64, 64, 0.05)


def peak_memory(spec: WorkloadSpec, engine: str, device: torch.device) -> dict[str, int] | None:
    """Measure how far memory rises above the inputs during a rendering, and during a gradient.

    On a CPU: the peak of the resident memory of a fresh process above what it had just before the call. A tiny gradient
    before that loads the libraries and the compiled loops; freed tensors of 64 KiB or more go back to the system at
    once (glibc), so that what the allocator would hold back does not count. On a GPU: the peak of the tensors above
    those of the inputs.

    Args:
        spec: of the workload.
        engine: what renders.
        device: where to render.

    Returns:
        Bytes for "forward" and "forward+backward"; None where the system does not tell (a CPU without Linux's /proc).

    Raises:
        RuntimeError: if the process that measures fails, or is killed for taking too much memory.
    """
    if device.type == "cuda":
        return _in_this_process(spec, engine, str(device), torch.get_num_threads())
    if not (PROCESS / "clear_refs").exists():
        return None
    task = Task("peak memory", _in_this_process, (spec, engine, str(device), torch.get_num_threads()))
    with mock.patch.dict(os.environ, {"MALLOC_MMAP_THRESHOLD_": str(1 << 16)}):
        [(_, outcome)] = run_all(Processes(1), [task], retries=0)
    if isinstance(outcome, Failure):
        raise RuntimeError(f"the process that measures peak memory failed: {outcome.error}\n{outcome.traceback}")
    measured: dict[str, int] = outcome.value
    return measured


def _in_this_process(spec: WorkloadSpec, engine: str, device: str, threads: int) -> dict[str, int]:
    """Measure here; nothing larger may have been rendered in this process before."""
    torch.set_num_threads(threads)
    render_fn, workload = render_with(engine), spec.make().to(device)
    gradients(render_fn, _TINY.make().to(device))
    before = restart_peak(workload.means.device)
    image(render_fn, workload)
    forward = peak_bytes(workload.means.device) - before
    before = restart_peak(workload.means.device)
    gradients(render_fn, workload)
    return {"forward": forward, "forward+backward": peak_bytes(workload.means.device) - before}


def restart_peak(device: torch.device) -> int:
    """Let the peak begin at the present memory; return that, bytes."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    (PROCESS / "clear_refs").write_text("5", encoding="ascii")  # 5 resets the peak (proc(5))
    return process_status("VmRSS")


def peak_bytes(device: torch.device) -> int:
    """Return the peak since the last restart, bytes."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else process_status("VmHWM")


def process_status(entry: str) -> int:
    """Return an entry of /proc/self/status, which is in KiB, as bytes."""
    lines = (PROCESS / "status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(f"{entry}:"))
