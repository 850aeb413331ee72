"""What the tests of the README and of the pages in docs and benchmarks read from Markdown."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def fenced_blocks(page: Path) -> list[tuple[str, str]]:
    """Return language and text of all fenced blocks, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """Return the texts of the blocks of one language."""
    return [text for found, text in fenced_blocks(page) if found == language]


def lines_missing(printed: str, *names: str) -> list[str]:
    """Return the lines that a command has printed and none of these pages of the evidence has."""
    there = {line for name in names for line in (ROOT / "benchmarks" / name).read_text("utf-8").splitlines()}
    return [line for line in printed.splitlines() if line and line not in there]


def broken_links(page: Path) -> list[str]:
    """Return the relative links of a page whose file, or whose heading in it, does not exist."""
    links = re.findall(r"(?:\]\(|^\[[\w-]+\]: )([^)\s]+)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [link for link in links if not re.match(r"\w+:", link) and not _leads_somewhere(page, link)]


def _leads_somewhere(page: Path, link: str) -> bool:
    name, _, anchor = link.partition("#")
    file = page.parent / name if name else page
    return file.exists() and (file.suffix != ".md" or not anchor or anchor in _anchors(file))


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page, as GitHub and MkDocs make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
