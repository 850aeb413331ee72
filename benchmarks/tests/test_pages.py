"""The pages of the evidence: what they link to and which tests they name exist, and the commands of ca-reg parse."""

import contextlib
import io
import re
import shlex

import pytest
from pages import ROOT, broken_links, fenced_blocks

from reference_trainer.cli import parse_command

PAGES = sorted((ROOT / "benchmarks").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    assert broken_links(page) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_tests_and_modules_exist(page):
    text = page.read_text("utf-8")
    named = set(re.findall(r"`([\w/]*\btest_\w+\.py)`", text))
    assert not [path for path in named if not (ROOT / path).is_file()]
    modules = {name.replace(".", "/") for name in re.findall(r"-m (benchmarks[a-z_.]+)", text)}
    assert not [name for name in modules if not (ROOT / f"{name}.py").is_file() and not (ROOT / name).is_dir()]


COMMANDS = {
    line
    for page in PAGES
    for line in re.findall(r"^ *(ca-reg [^#`\n]+)(?=#|$)", page.read_text("utf-8").replace("\\\n", ""), re.MULTILINE)
    if not re.search(r"\.\.\.|[<$]", line)  # what the reader is to fill in
}


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_commands_are_understood(command):
    assert callable(parse_command(shlex.split(command)[1:]))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_prints_what_stands_below_it(page):
    printed = ""
    for language, text in fenced_blocks(page):
        if language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(text, page.name, "exec"), {})
            printed = out.getvalue()
        elif language == "text":
            assert text == printed
