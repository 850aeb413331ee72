"""What the README promises exists."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from reference_trainer.cli import _parse

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


COMMANDS = [line.split("#")[0] for block in blocks("bash") for line in re.findall(r"\bca-reg .*", block)]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command):
    assert callable(_parse(shlex.split(command)[1:]))


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_parse_and_their_imports_work(code):
    tree = ast.parse(code)
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert imports
    exec(compile(ast.Module(imports, type_ignores=[]), "README.md", "exec"), {})


def test_two_lines_do_what_the_readme_says():
    import torch

    from ca_reg import GaussianDropout

    dropout = GaussianDropout(p=0.2)
    opacity = dropout(torch.full((1000, 1), 0.5))
    radii = dropout.mask_radii(torch.ones(1000, dtype=torch.int32))
    assert torch.equal(radii == 0, opacity.squeeze(1) == 0)
    assert 0 < (radii == 0).sum() < 1000
    assert torch.equal(dropout.eval()(torch.full((1000, 1), 0.5)), torch.full((1000, 1), 0.4))


def test_linked_files_exist():
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if not link.startswith("http")]
    assert links
    assert not [link for link in links if not (ROOT / link).exists()]
