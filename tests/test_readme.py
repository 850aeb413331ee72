"""What the README promises exists."""

import ast

import pytest
from pages import ROOT, blocks

README = ROOT / "README.md"


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
