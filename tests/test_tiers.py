"""Which tests a command runs, and in how many processes."""

from types import SimpleNamespace

import pytest
import tiers

PLAIN = {"markexpr": "not slow", "usepdb": False, "trace": False, "capture": "fd", "collectonly": False}
XDIST = {"numprocesses": None, "maxprocesses": None, "dist": "no", "tx": []}
EVERYTHING, ONE = ["tests", "ca_reg"], ["tests/test_docs.py::test_named_tests_exist"]


def asked(args, **options):
    config = SimpleNamespace(args=args, option=SimpleNamespace(**PLAIN | options))
    tiers.pytest_cmdline_main(config)
    return config.option


@pytest.mark.parametrize(
    ("args", "markers", "left"),
    [
        (EVERYTHING, "not slow", "not slow"),
        (EVERYTHING, "slow", "slow"),
        (EVERYTHING, "", ""),
        (ONE, "not slow", ""),
        ([*ONE, "tests/test_docs.py"], "not slow", "not slow"),
        (ONE, "gpu", "gpu"),
    ],
)
def test_a_test_named_by_its_id_is_run_whatever_its_tier(args, markers, left):
    assert asked(args, markexpr=markers).markexpr == left


@pytest.mark.parametrize(
    ("args", "options", "processes", "dist"),
    [
        (EVERYTHING, {}, "auto", "worksteal"),
        (["tests/fuzz"], {"markexpr": "slow"}, "auto", "worksteal"),
        (EVERYTHING, {"numprocesses": 0}, 0, "no"),
        (EVERYTHING, {"numprocesses": 3}, 3, "worksteal"),
        (EVERYTHING, {"numprocesses": 3, "dist": "loadfile"}, 3, "loadfile"),
        (EVERYTHING, {"tx": ["popen"], "dist": "each"}, None, "each"),
        (EVERYTHING, {"usepdb": True}, None, "no"),
        (EVERYTHING, {"trace": True}, None, "no"),
        (EVERYTHING, {"capture": "no"}, None, "no"),
        (EVERYTHING, {"collectonly": True}, None, "no"),
        (ONE, {}, None, "no"),
        (["tests/test_docs.py"], {}, None, "no"),
    ],
)
def test_folders_run_on_all_processors_unless_asked_otherwise(args, options, processes, dist):
    found = asked(args, **XDIST | options)
    assert (found.numprocesses, found.dist) == (processes, dist)


def test_without_xdist_nothing_is_asked_of_it():
    assert not hasattr(asked(EVERYTHING), "numprocesses")
