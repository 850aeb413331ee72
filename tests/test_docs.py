"""What the pages promise: their Python runs and prints what they say, and what they name exists."""

import ast
import contextlib
import importlib
import io
import re
import shlex

import pytest
from pages import ROOT, blocks, broken_links, fenced_blocks

from reference_trainer.cli import parse_command

PAGES = {page.name: page for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]}
WITH_CODE = [name for name, page in PAGES.items() if blocks(page, "python") and name != "README.md"]  # see test_readme
EXCERPTS = [text for page in PAGES.values() for text in blocks(page, "py")]
COMMANDS = sorted(
    {
        " ".join(line.split())
        for page in PAGES.values()
        for line in re.findall(
            r"^ *(?:.*&& )?(ca-reg [^#`\n]+)(?=#|$)", page.read_text("utf-8").replace("\\\n", ""), re.M
        )
        if not re.search(r"\.\.\.|[<$]", line)  # what the reader is to fill in
    }
)


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


@pytest.mark.parametrize("excerpt", EXCERPTS)
def test_excerpts_import_what_exists(excerpt):
    for node in ast.walk(ast.parse(excerpt)):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in ("ca_reg", "reference_trainer"):
            if "triton" in node.module:
                pytest.importorskip("triton")
            module = importlib.import_module(node.module)
            assert [name.name for name in node.names if not hasattr(module, name.name)] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command):
    assert callable(parse_command(shlex.split(command)[1:]))


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    assert broken_links(PAGES[name]) == []


def test_named_tests_exist():
    named = {
        path for page in PAGES.values() for path in re.findall(r"`([\w/]*\btest_\w+\.py)`", page.read_text("utf-8"))
    }
    assert named
    assert not [path for path in named if not (ROOT / path).is_file()]
