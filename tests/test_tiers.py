"""Which tests a command runs, and in how many processes."""

from types import SimpleNamespace

import pytest
import tiers
from pages import ROOT

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


@pytest.mark.parametrize(("text", "left_out"), [("", True), ("pytestmark = pytest.mark.slow", None)])
def test_the_slow_tier_imports_no_file_without_a_slow_test(tmp_path, text, left_out):
    (tmp_path / "test_x.py").write_text(text)
    assert tiers.WithoutQuickFiles.pytest_ignore_collect(tmp_path / "test_x.py") is left_out
    assert tiers.WithoutQuickFiles.pytest_ignore_collect(tmp_path) is None
    assert tiers.WithoutQuickFiles.pytest_ignore_collect(ROOT / "benchmarks" / "tests" / "test_plan.py") is None


def test_no_file_makes_tests_of_another_slow():
    """Or they would be missing there; the two that are not collected run in Triton's interpreter."""
    marking = [
        path.name for folder in ("tests", "ca_reg", "reference_trainer") for path in (ROOT / folder).rglob("*.py")
        if not path.name.startswith("test_") and "mark.slow" in path.read_text("utf-8")
    ]  # fmt: skip
    assert sorted(marking) == ["gsplat_lists.py", "interpreted.py", "tiers.py"]
