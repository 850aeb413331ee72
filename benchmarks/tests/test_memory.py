"""The peak of the resident memory."""

import mmap
import os
from pathlib import Path

import pytest
import torch

from benchmarks import memory
from benchmarks.memory import peak_memory
from benchmarks.workloads import WorkloadSpec

needs_proc = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's /proc")

MIB = 1 << 20


def touch(mib):
    """Hold memory for a moment; not from the allocator, which may have as much left over."""
    with mmap.mmap(-1, mib * MIB) as memory:
        memory[::4096] = bytes(mib * MIB // 4096)


@needs_proc
def test_the_peak_is_that_of_what_is_gone_already():
    cpu = torch.device("cpu")
    touch(128)  # an older and higher peak
    before = memory.restart_peak(cpu)
    touch(64)
    assert memory.peak_bytes(cpu) - before == pytest.approx(64 * MIB, rel=0.02)


@pytest.mark.slow
@needs_proc
def test_a_fresh_process_measures_a_rendering():
    peaks = peak_memory(WorkloadSpec(300, 512, 512, 0.05), "torch", torch.device("cpu"))
    assert list(peaks) == ["forward", "forward+backward"]
    picture = 3 * 512 * 512 * 4
    assert picture <= peaks["forward"] <= peaks["forward+backward"] < 500 * MIB
    assert "MALLOC_MMAP_THRESHOLD_" not in os.environ


@pytest.mark.slow
@needs_proc
def test_a_failure_in_the_fresh_process_is_an_error_here():
    with pytest.raises(RuntimeError, match="failed: ValueError: negative"):
        peak_memory(WorkloadSpec(-1, 8, 8, 0.1), "torch", torch.device("cpu"))


@pytest.mark.gpu
def test_on_a_gpu_the_tensors_count():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    peaks = peak_memory(WorkloadSpec(300, 64, 48, 0.05), "torch", torch.device("cuda"))
    assert 0 < peaks["forward"] <= peaks["forward+backward"]


def test_without_proc_there_is_no_number(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "PROCESS", tmp_path)
    assert peak_memory(WorkloadSpec(5, 8, 8, 0.1), "torch", torch.device("cpu")) is None
