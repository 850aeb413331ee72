"""What the pages in docs promise: their Python runs and prints what they say, and what they name exists."""

import contextlib
import io
import re

import pytest
from pages import ROOT, blocks, fenced_blocks, linked_files

PAGES = {page.name: page for page in sorted((ROOT / "docs").glob("*.md"))}
WITH_CODE = [name for name, page in PAGES.items() if blocks(page, "python")]


@pytest.mark.parametrize("name", WITH_CODE)
def test_python_runs_and_prints_what_stands_below_it(name):
    namespace, printed = {}, ""
    for language, text in fenced_blocks(PAGES[name]):
        if language == "python":
            assert not printed, f"the page does not show what a block prints:\n{printed}"
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(text, name, "exec"), namespace)
            printed = out.getvalue()
        elif language == "text":
            assert text == printed
            printed = ""
    assert not printed


@pytest.mark.parametrize("name", PAGES)
def test_linked_files_exist(name):
    assert not [link for link, file in linked_files(PAGES[name]).items() if not file.exists()]


def test_named_tests_exist():
    named = {
        path for page in PAGES.values() for path in re.findall(r"`([\w/]*\btest_\w+\.py)`", page.read_text("utf-8"))
    }
    assert named
    assert not [path for path in named if not (ROOT / "tests" / path).is_file()]
