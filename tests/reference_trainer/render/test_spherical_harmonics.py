"""Spherical harmonics against SciPy's."""

import pytest
import torch
from oracles import spherical_harmonics

from reference_trainer.render.torch.spherical_harmonics import evaluate_sh, sh_basis


def test_the_basis_is_scipys():
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1
    )
    torch.testing.assert_close(sh_basis(directions, 3), spherical_harmonics(directions, 3), rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_a_prefix(degree):
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    coefficients = torch.randn(5, (degree + 1) ** 2, 3, dtype=torch.float64)
    expected = torch.einsum("nk,nkc->nc", sh_basis(directions, 3)[:, : (degree + 1) ** 2], coefficients)
    torch.testing.assert_close(evaluate_sh(coefficients, directions, degree), (expected + 0.5).clamp(min=0))
