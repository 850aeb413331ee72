"""The stand-ins for `fused_ssim`, against kornia, and for the two forms of `simple_knn`."""

import pytest
import torch
from kornia.metrics import ssim
from torch.nn.functional import pad

from reference_trainer.compat.extensions import distCUDA2, fused_ssim


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_values_and_gradients_are_kornias(padding):
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(2, 3, 17, 21, generator=generator).double() for _ in range(2))
    leaves = [image.clone().requires_grad_() for _ in range(2)]
    border = 5 if padding == "same" else 0
    padded = (pad(x, (border,) * 4) for x in (leaves[1], target))
    values = [fused_ssim(leaves[0], target, padding=padding), ssim(*padded, 11, eps=0.0, padding="valid").mean()]
    torch.testing.assert_close(*values, rtol=1e-9, atol=1e-9)
    for value in values:
        value.backward()
    torch.testing.assert_close(leaves[0].grad, leaves[1].grad, rtol=1e-7, atol=1e-9)


def test_another_padding_is_refused():
    with pytest.raises(ValueError, match=r"padding .*'valid', got 'reflect'"):
        fused_ssim(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16), padding="reflect")


def test_both_forms_of_the_extension(generator):
    points = torch.rand(20, 3, generator=generator).requires_grad_()
    squares = (points.detach()[:, None] - points.detach()).square().sum(-1).fill_diagonal_(torch.inf)
    expected = squares.sort(dim=1)
    alone = distCUDA2(points)
    torch.testing.assert_close(alone, expected.values[:, :3].mean(1))
    assert not alone.requires_grad
    assert torch.equal(distCUDA2(points)[0], alone)
    distances, numbers = distCUDA2(points)
    assert torch.equal(distances, alone)
    assert torch.equal(numbers, expected.indices[:, :3].int())
    assert numbers.dtype == torch.int32


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match=r"\(N, 3\) with N > 3"):
        distCUDA2(torch.zeros(3, 3))
