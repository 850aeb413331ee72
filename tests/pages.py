"""What the tests of the README and of the pages in docs read from Markdown."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def fenced_blocks(page: Path) -> list[tuple[str, str]]:
    """Return language and text of all fenced blocks, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """Return the texts of the blocks of one language."""
    return [text for found, text in fenced_blocks(page) if found == language]


def linked_files(page: Path) -> dict[str, Path]:
    """Return the relative links of a page, without their anchors, and where they lead."""
    links = re.findall(r"(?:\]\(|^\[[\w-]+\]: )([^)#\s]+)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {link: page.parent / link for link in links if not re.match(r"\w+:", link)}
