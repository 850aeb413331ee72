"""What a step frees stays with the process: the next one need not get it anew from the system, page by page."""

import os
import platform
import subprocess
import sys

import pytest

_FAULTS = """
import resource
import reference_trainer, torch

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

for step in range(40):
    torch.ones(4 << 20)
    if step == 20:
        before = faults()
print(faults() - before)
"""


def _faults(**variables: str) -> int:
    environment = {name: x for name, x in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    ran = subprocess.run(
        [sys.executable, "-c", _FAULTS], env=environment | variables, capture_output=True, text=True, check=True
    )
    return int(ran.stdout)


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator of glibc")
def test_freed_memory_stays_unless_the_environment_says_otherwise():
    """Tensors of 16 MiB, one after the other: at pages of 4 KiB, 4,096 faults each where they are returned."""
    returned = _faults(MALLOC_MMAP_THRESHOLD_=str(1 << 16))
    assert _faults() < returned / 4
