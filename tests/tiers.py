"""How a run of the tests is cut into tiers and spread over the processors."""

from pathlib import Path

import pytest

QUICK = "not slow"  # the tier that pyproject.toml asks for
SLOW = "slow"
EVIDENCE = Path(__file__).parents[1] / "benchmarks"  # all of its tests are slow, and its conftest.py says so
WORKERS = 8  # at most: each imports torch and collects all tests before its first one


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks at its options
def pytest_cmdline_main(config):
    """Run what is named by its id whatever its tier, and whole folders on all processors, with pytest-xdist."""
    option = config.option
    if option.markexpr == QUICK and all("::" in name for name in config.args):
        option.markexpr = ""
    if hasattr(config, "workerinput") or not hasattr(option, "numprocesses"):
        return  # a worker, or no pytest-xdist
    attended = option.usepdb or option.trace or option.capture == "no" or option.collectonly
    files = all("::" in name or name.endswith(".py") for name in config.args)
    if option.numprocesses is None and option.dist == "no" and not (option.tx or attended or files):
        option.numprocesses, option.maxprocesses = "auto", option.maxprocesses or WORKERS
    if option.numprocesses and option.dist == "no":
        option.dist = "worksteal"  # neighbors stay together, and with them what a file's fixtures have made


class WithoutQuickFiles:
    """Leaves out files of which no test is slow where no other is asked for: every process would import them all."""

    @staticmethod
    def pytest_ignore_collect(collection_path):
        if collection_path.suffix != ".py" or collection_path.is_relative_to(EVIDENCE):
            return None
        return None if "mark.slow" in collection_path.read_text("utf-8") else True


def pytest_configure(config):
    """Cut the slow tier."""
    if config.option.markexpr == SLOW:
        config.pluginmanager.register(WithoutQuickFiles())
