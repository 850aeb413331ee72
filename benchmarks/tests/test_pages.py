"""The pages of the evidence: what they link to and which tests they name exist, and the commands of ca-reg parse."""

import contextlib
import io
import re
import shlex

import pytest
from pages import ROOT, fenced_blocks, linked_files

from reference_trainer.cli import parse_command

PAGES = sorted((ROOT / "benchmarks").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_files_exist(page):
    assert not [link for link, file in linked_files(page).items() if not file.exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_headings_exist(page):
    for link in re.findall(r"\]\(([^)\s]*#[^)\s]+)\)", page.read_text("utf-8")):
        file, _, anchor = link.partition("#")
        assert anchor in headings(page.parent / file if file else page), link


def headings(page):
    """Return the anchors of a page, as GitHub and MkDocs make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


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
