"""Tiny scenes and schedules, as for the tests of the trainer; all tests of the evidence are in the slow tier."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import data_root as data_root
from tiny import busy as busy
from tiny import options as options
from tiny import short as short
from tiny import tiny_scene as tiny_scene

HERE = Path(__file__).parent
collect_ignore = ["ahead.py"] if find_spec("triton") is None else []  # it compiles kernels, at their import


def pytest_collection_modifyitems(items):
    """Mark them, so that the product's quick tests contain none."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.slow)
