"""Everything in benchmarks can be started as its README says, without the folder of the tests in the path."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_every_module_can_be_imported_from_the_root_of_a_checkout():
    for extra in ("triton", "viser"):
        pytest.importorskip(extra)
    names = sorted(f"benchmarks.{path.stem}" for path in (ROOT / "benchmarks").glob("*.py") if path.stem != "conftest")
    script = f"from importlib import import_module\nfor name in {names}:\n    import_module(name)"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert not done.returncode, done.stderr
