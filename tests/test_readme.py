"""What the README promises exists."""

import ast
import re
import shlex

import pytest
from pages import ROOT, blocks, linked_files

from reference_trainer.cli import _parse

README = ROOT / "README.md"
COMMANDS = [line.split("#")[0] for block in blocks(README, "bash") for line in re.findall(r"\bca-reg .*", block)]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command):
    assert callable(_parse(shlex.split(command)[1:]))


@pytest.mark.parametrize("code", blocks(README, "python"))
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
    files = linked_files(README)
    assert files
    assert not [link for link, file in files.items() if not file.exists()]
