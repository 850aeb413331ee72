"""What a command prints, and how it refuses."""

import re

import pytest

from reference_trainer.cli import main


def plain(text: str) -> str:
    """Strip colors and boxes, and join the lines."""
    return " ".join(re.sub(r"\x1b\[[0-9;]*m|[│╭╮╰╯─]", " ", text).split())


def refused(arguments: list[str], capsys) -> str:
    """Run a command that must fail with exit code 2, and return what it says."""
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    return plain(capsys.readouterr().err)
