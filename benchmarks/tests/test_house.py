"""The tables of the house, on a small checkout whose figures are known, and the ways through this one."""

from pathlib import Path

import pytest

from benchmarks import house

FILES = {
    "ca_reg/__init__.py": '"""Doc."""\n\nfrom ca_reg.a import f\n\n__all__ = ["f", "__version__"]\n',
    "ca_reg/a.py": "def f():\n    from ca_reg import b  # late\n    return b\n",
    "ca_reg/b.py": "# why\nimport ca_reg.a  # noqa: F401\n",
    "integrations/__init__.py": "from reference_trainer.runs import run\n",
    "reference_trainer/__init__.py": "",
    "reference_trainer/files.py": "import reference_trainer.runs\n",
    "reference_trainer/runs/__init__.py": "",
    "docs/page.md": "# Four words in all\n",
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_the_table_counts_what_is_there(checkout, capsys):
    house.main([str(checkout)])
    text = capsys.readouterr().out
    for line in ("| installed lines | 12 |", "| lines of ca_reg | 10 |", "| words in docs | 5 |",
                 "| names exported by ca_reg | 1 |", "| circles of imports | 1 |",
                 "| `ca_reg` | 33.3 | 4 |", "| `integrations` | 0.0 | 4 |",
                 "- circle: ca_reg.", "- upward: reference_trainer.files -> reference_trainer.runs"):  # fmt: skip
        assert line in text


@pytest.mark.parametrize(
    ("line", "comments"),
    [("x = 1  # unit", 1), ("x = 1  # fmt: skip", 0), ("x = 1  # type: ignore[misc, arg-type]  # noqa: E1, B2", 0),
     ("x = 1  # noqa: B023 - called at once", 1), ("x = 1  # unit  # fmt: skip", 1), ('x = "# no"', 0)],
)  # fmt: skip
def test_what_is_written_for_linters_is_no_comment(line, comments):
    assert house.comments_and_code(f"{line}\n") == (comments, 1)


PINNING = """
from a import b, _c
from a._d import e
import pytest


class Fake:
    def f(self):
        return self._own


def test(monkeypatch, case):
    monkeypatch.setattr(b, "_f", 1)
    monkeypatch.setattr("a.b.c", case._replace(x=b._f))
    with pytest.raises(ValueError, match=r"one two three, --no-more and 'four' in x\\.py"):
        e()
    assert "one two three four five" in f"one {b} two three four"
"""


def test_what_tests_pin_is_counted():
    counts = house.pinned([PINNING])
    assert counts == {"matches of 4 words": 1, "matches of 6 words": 0, "asserts on 5 words": 1,
                      "reads of private names": 1, "imports of private names": 2,
                      "patches of private names": 1}  # fmt: skip


def test_the_tests_pin_no_more_than_they_did(capsys):
    """Where a count has fallen, its limit in `house.PINNED` falls with it."""
    house.main(["--tests"])
    table = capsys.readouterr().out
    counts = house.pinned(house.tests(Path(__file__).parents[2]))
    assert all(f"| {name} | {counts[name]} | {most} |" in table for name, most in house.PINNED.items())
    assert {name: max(count, house.PINNED[name]) for name, count in counts.items()} == house.PINNED


def test_no_way_from_the_readme_is_lost():
    rows = house.walked(Path(__file__).parents[2])
    assert len(rows) == len(house.WALKS)
    assert all(row["files"] <= 3 and row["lines read"] <= 150 for row in rows)


def test_a_way_that_is_lost_is_named(checkout, monkeypatch):
    monkeypatch.setattr(house, "WALKS", {"goal": (("ca_reg/a.py", "def f", "def g"),)})
    with pytest.raises(ValueError, match=r"ca_reg/a\.py"):
        house.walked(checkout)
