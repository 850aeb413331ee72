"""The environment of processes that tests start."""

import os
from pathlib import Path

__all__ = ["PYTHONPATH", "subprocess_environment"]

TESTS = Path(__file__).parent
PYTHONPATH = os.pathsep.join([str(TESTS.parent), str(TESTS)])  # folders of the tests have names of packages
"""Where a process finds the package, and the tests' own modules."""


def subprocess_environment(**changes: str) -> dict[str, str]:
    """The environment for a process of its own, with one thread and `PYTHONPATH`."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": PYTHONPATH, **changes}
