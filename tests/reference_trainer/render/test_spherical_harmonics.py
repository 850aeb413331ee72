"""Spherical harmonics against associated Legendre polynomials and orthonormality."""

import pytest
import torch
from oracles import associated_legendre_sh

from reference_trainer.render.eager.spherical_harmonics import evaluate_sh, sh_basis


def test_basis_equals_legendre_definition():
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1
    )
    expected = torch.stack([associated_legendre_sh(d, 3) for d in directions])
    torch.testing.assert_close(sh_basis(directions, 3), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_a_prefix(degree):
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    coefficients = torch.randn(5, 16, 3, dtype=torch.float64)
    expected = torch.einsum(
        "nk,nkc->nc", sh_basis(directions, 3)[:, : (degree + 1) ** 2], coefficients[:, : (degree + 1) ** 2]
    )
    torch.testing.assert_close(evaluate_sh(coefficients, directions, degree), (expected + 0.5).clamp(min=0))


def test_too_few_coefficients_and_unknown_degree():
    with pytest.raises(ValueError, match="needs 9 coefficients, got 4"):
        evaluate_sh(torch.zeros(1, 4, 3), torch.eye(3)[:1], 2)
    with pytest.raises(ValueError, match="0, 1, 2 or 3, got 4"):
        sh_basis(torch.eye(3), 4)
