from __future__ import annotations

import math

import numpy as np
import pytest
import skimage.metrics
import torch
from torch import Tensor

from reference_trainer.evaluation.metrics import on_white, psnr, ssim


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    return 0.6 * target + 0.4 * torch.rand(3, height, width, generator=generator, dtype=torch.float64), target


def direct_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Return the definition: for each pixel the weighted moments of its zero-padded window, centered, by a loop."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2
    x, y = (np.pad(z, ((0, 0), (5, 5), (5, 5))) for z in (x, y))
    values = []
    for c in range(x.shape[0]):
        for i in range(x.shape[1] - 10):
            for j in range(x.shape[2] - 10):
                a, b = x[c, i : i + 11, j : j + 11], y[c, i : i + 11, j : j + 11]
                ma, mb = (window * a).sum(), (window * b).sum()
                va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
                cov = (window * (a - ma) * (b - mb)).sum()
                values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


@pytest.mark.parametrize("size", [(1, 1), (4, 15), (13, 12), (20, 24)])
def test_ssim_equals_its_definition(size):
    image, target = pair(*size)
    assert ssim(image, target) == pytest.approx(direct_ssim(image.numpy(), target.numpy()), abs=1e-9)


def test_ssim_equals_skimage_where_all_is_zero_near_the_border():
    # With a frame of zeros as wide as the window, skimage's reflection at the border sees zeros too.
    image, target = pair(40, 50)
    frame = torch.zeros(40, 50, dtype=torch.float64)
    frame[11:-11, 11:-11] = 1
    image, target = image * frame, target * frame
    _, full = skimage.metrics.structural_similarity(
        image.numpy(),
        target.numpy(),
        channel_axis=0,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    assert ssim(image, target) == pytest.approx(full.mean(), abs=1e-9)


def test_ssim_of_flat_images_far_inside_is_the_closed_form():
    # Constant images a and b have no variance: luminance alone counts, wherever the window sees no border.
    a, b = 0.2, 0.9
    inside = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    image, target = torch.full((1, 211, 211), a), torch.full((1, 211, 211), b)
    rim = 1 - (201 / 211) ** 2
    assert abs(ssim(image, target) - inside) <= rim


def test_ssim_is_symmetric_and_one_only_for_equal_images():
    image, target = pair(20, 24)
    assert ssim(image, target) == pytest.approx(ssim(target, image), abs=1e-12)
    assert ssim(image, target) < 0.99
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)


def test_ssim_of_float32_images_never_exceeds_one():
    flat = torch.full((3, 30, 30), 0.9) + 1e-4 * torch.rand(3, 30, 30, generator=torch.Generator().manual_seed(0))
    assert flat.dtype == torch.float32
    assert ssim(flat, flat) <= 1 + 1e-12


@pytest.mark.parametrize("size", [(5, 7), (20, 24)])
def test_psnr_equals_skimage(size):
    image, target = pair(*size)
    expected = skimage.metrics.peak_signal_noise_ratio(target.numpy(), image.numpy(), data_range=1.0)
    assert psnr(image, target) == pytest.approx(expected, abs=1e-10)


def test_psnr_of_equal_images_is_infinite():
    assert psnr(torch.ones(3, 4, 4), torch.ones(3, 4, 4)) == math.inf


def test_psnr_falls_by_twenty_decibels_when_the_error_grows_tenfold():
    image, target = pair(10, 10)
    assert psnr(target + 0.1 * (image - target), target) - psnr(image, target) == pytest.approx(20, abs=1e-9)


def test_in_a_mask_psnr_has_the_error_of_its_pixels_alone():
    mask = torch.zeros(6, 8)
    mask[1:4, 2:7] = 1
    mask[5] = 254 / 255  # the edge of a mask, which is none
    target = torch.full((3, 6, 8), 0.5, dtype=torch.float64)
    image = target + torch.where(mask == 1, 0.1, 0.4)
    assert psnr(image, target, mask) == pytest.approx(20, abs=1e-5)  # -10 log10(0.1^2)
    assert psnr(target.where(mask == 1, 0.0), target, mask) == math.inf
    assert math.isnan(psnr(image, target, torch.zeros(6, 8)))


def test_over_the_masked_picture_ssim_is_that_of_pictures_that_are_white_outside():
    image, target = pair(20, 24)
    mask = torch.zeros(20, 24)
    mask[4:15, 6:20] = 1
    outside = torch.rand(3, 20, 24, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert ssim(on_white(target, mask), on_white(target.where(mask == 1, outside), mask)) == pytest.approx(1, abs=1e-12)
    white = [np.where(mask == 1, x, 1.0) for x in (image.numpy(), target.numpy())]
    assert ssim(on_white(image, mask), on_white(target, mask)) == pytest.approx(direct_ssim(*white), abs=1e-9)


def test_inputs_may_carry_gradients():
    image, target = pair(12, 12)
    assert psnr(image.clone().requires_grad_(), target) == pytest.approx(psnr(image, target), rel=1e-12)
    assert ssim(image.clone().requires_grad_(), target) == pytest.approx(ssim(image, target), rel=1e-12)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_wrong_images(metric):
    with pytest.raises(ValueError, match=r"shape .*got \(3, 4, 5\) and \(3, 5, 4\)"):
        metric(torch.zeros(3, 4, 5), torch.zeros(3, 5, 4))
    with pytest.raises(ValueError, match="share one shape"):
        metric(torch.zeros(1, 3, 4, 5), torch.zeros(1, 3, 4, 5))
    with pytest.raises(ValueError, match="finite"):
        metric(torch.full((3, 12, 12), math.nan), torch.zeros(3, 12, 12))
