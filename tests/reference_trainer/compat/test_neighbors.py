"""The two forms of the extension ``simple_knn``."""

import pytest
import torch

from reference_trainer.compat.neighbors import neighbor_modules


def test_both_forms_of_the_extension(generator):
    points = torch.rand(20, 3, generator=generator).requires_grad_()
    squares = (points.detach()[:, None] - points.detach()).square().sum(-1).fill_diagonal_(torch.inf)
    expected = squares.sort(dim=1)
    alone = neighbor_modules(indices=False)["simple_knn._C"].distCUDA2(points)
    pair = neighbor_modules(indices=True)["simple_knn._C"].distCUDA2(points)
    torch.testing.assert_close(alone, expected.values[:, :3].mean(1))
    assert not alone.requires_grad
    assert torch.equal(pair[0], alone)
    assert torch.equal(pair[1], expected.indices[:, :3].int())
    assert pair[1].dtype == torch.int32


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match=r"\(N, 3\) with N > 3"):
        neighbor_modules(indices=False)["simple_knn._C"].distCUDA2(torch.zeros(3, 3))
