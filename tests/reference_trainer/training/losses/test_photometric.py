""""""

from __future__ import annotations

import os

import pytest
import torch
from torch import Tensor

from ca_reg import Chain, GaussianDropout
from reference_trainer.evaluation.metrics import ssim
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.photometric import Views, expected_photometric_loss, photometric_loss, ssim_map
from reference_trainer.training.trainer import Trainer

CHOSEN = os.environ.get("CA_REG_ENGINE") == "triton"  # by `tests/reference_trainer/render/triton/test_interpreted.py`
DEVICE = torch.device("cuda" if CHOSEN and os.environ.get("TRITON_INTERPRET") != "1" else "cpu")


def pair(height: int, width: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    noise = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    return (0.7 * target + 0.3 * noise).to(dtype), target.to(dtype)


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (5, 6), (11, 11), (33, 20), (40, 61)])
def test_equals_the_metric(size):
    image, target = pair(*size)
    assert ssim_map(image, target).mean().item() == pytest.approx(ssim(image, target), abs=1e-12)


def test_every_pixel_equals_a_direct_sum():
    image, target = pair(9, 14)
    similarity = ssim_map(image, target)
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    line = torch.exp(-offsets.square() / (2 * 1.5**2))
    window = line[:, None] * line[None] / line.sum() ** 2
    for c, i, j in [(0, 0, 0), (1, 4, 7), (2, 8, 13), (0, 3, 12)]:
        x, y, w = [], [], []
        for di in range(-5, 6):
            for dj in range(-5, 6):
                inside = 0 <= i + di < 9 and 0 <= j + dj < 14
                x.append(image[c, i + di, j + dj].item() if inside else 0.0)
                y.append(target[c, i + di, j + dj].item() if inside else 0.0)
                w.append(window[di + 5, dj + 5].item())
        x, y, w = (torch.tensor(values, dtype=torch.float64) for values in (x, y, w))
        mx, my = (w * x).sum(), (w * y).sum()
        vx, vy, cov = (w * (x - mx) ** 2).sum(), (w * (y - my) ** 2).sum(), (w * (x - mx) * (y - my)).sum()
        expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
        torch.testing.assert_close(similarity[c, i, j], expected, atol=1e-13, rtol=0)


@pytest.mark.parametrize("size", [(3, 4), (13, 7)])
def test_gradient_of_the_map(size):
    image, target = pair(*size)
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, target), (image.requires_grad_(),))


@pytest.mark.parametrize("size", [(1, 1), (3, 4), (13, 70), (40, 61)])
@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_float32_agrees_with_float64(size, spread):
    """Float32 is computed by numba's loops on the processor and by Triton's kernels on a card; float64 never is."""
    results = []
    for dtype, device in ((torch.float32, DEVICE), (torch.float64, "cpu")):
        image, target = (x.to(device) for x in pair(*size, dtype=dtype))
        image, variance = image.requires_grad_(), (spread * image.detach() ** 2).requires_grad_()
        weights = pair(*size, dtype=dtype, seed=1)[0].to(device)
        similarity = ssim_map(image, target, variance)
        results.append([similarity.detach(), *torch.autograd.grad((similarity * weights).sum(), (image, variance))])
    for short, long in zip(*results, strict=True):
        # Rounding: the squares of colors near 1, against the constant 9e-4 that they are compared with.
        assert (short.cpu() - long).norm() <= 1e-4 * long.norm()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (17, 6)])
@pytest.mark.parametrize("spread", [None, 0.0, 0.1])
def test_float32_losses_agree_with_float64(size, spread):
    """Of strided pictures, some of whose pixels are those of the photograph, within a larger expression."""
    results = []
    for dtype, device in ((torch.float32, DEVICE), (torch.float64, "cpu")):
        image, target = (x.to(device, dtype) for x in pair(*size, dtype=torch.float32))
        image = torch.cat([image, target[:1]]).permute(1, 2, 0).contiguous().permute(2, 0, 1).requires_grad_()
        variance = None if spread is None else (spread * image.detach()[:3] ** 2).requires_grad_()
        losses = [
            photometric_loss(x, target, 0.3) if spread is None else expected_photometric_loss(x, variance, target, 0.3)
            for x in (image[:3], torch.cat([image[3:], image[:2]]))
        ]
        value = losses[0] + losses[1] ** 2
        leaves = (image,) if spread is None else (image, variance)
        results.append([value.detach(), *torch.autograd.grad(value, leaves)])
    for short, long in zip(*results, strict=True):
        assert (short.cpu() - long).norm() <= 1e-5 * long.norm()


@pytest.mark.skipif(not CHOSEN, reason="counts the launches of Triton's kernels")
def test_float32_takes_two_launches_and_two_back():
    from reference_trainer.render.triton.launching import LAUNCHED

    image, target = (x.to(DEVICE) for x in pair(5, 6, dtype=torch.float32))
    before = LAUNCHED.total()
    loss = photometric_loss(image.requires_grad_(), target)
    assert LAUNCHED.total() - before == 2
    loss.backward()
    assert LAUNCHED.total() - before == 4


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_gradient_of_the_loss(weight):
    image, target = pair(8, 9)
    # Away from the kink of |x| at 0: the finite difference of 1e-6 must not cross it.
    assert (image - target).abs().min() > 1e-5
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, weight), (image.requires_grad_(),))


def test_loss_is_the_weighted_sum():
    image, target = pair(20, 30)
    expected = 0.7 * (image - target).abs().mean().item() + 0.3 * (1 - ssim(image, target))
    assert photometric_loss(image, target, 0.3).item() == pytest.approx(expected, abs=1e-12)
    assert photometric_loss(target, target).item() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_float32_stays_near_float64(level):
    # The variances are differences of numbers near level^2, each rounded to some 2^-24 level^2 per operation; a few
    # dozen operations over the smallest denominator, 9e-4, bound the error. Flat images are the worst case.
    generator = torch.Generator().manual_seed(0)
    target = (level + 1e-3 * torch.randn(3, 20, 25, generator=generator)).float()
    image = (target + 1e-3 * torch.randn(3, 20, 25, generator=generator)).float().to(DEVICE)
    target = target.to(DEVICE)
    bound = 32 * 2**-24 * max(level, 0.05) ** 2 / 9e-4 + 1e-5
    exact, x = ssim_map(image.double(), target.double()), image.clone().requires_grad_()
    assert (ssim_map(image, target) - exact).abs().max() < bound
    photometric_loss(x, target).backward()
    y = image.double().requires_grad_()
    photometric_loss(y, target.double()).backward()
    assert (x.grad - y.grad).norm() < 1e-2 * y.grad.norm()


def test_float32_gradient_of_textured_images():
    image, target = pair(20, 25)
    image32, target32 = image.float().to(DEVICE).requires_grad_(), target.float().to(DEVICE)
    photometric_loss(image32, target32).backward()
    image.requires_grad_()
    photometric_loss(image, target).backward()
    assert (image32.grad.cpu() - image.grad).norm() < 1e-5 * image.grad.norm()


def test_layout_does_not_matter():
    image, target = pair(12, 17)
    strided = image.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    assert not strided.is_contiguous()
    torch.testing.assert_close(ssim_map(strided, target), ssim_map(image, target), atol=0, rtol=0)


def test_inputs_are_untouched():
    image, target = pair(12, 17)
    before = image.clone(), target.clone()
    photometric_loss(image.requires_grad_(), target).backward()
    assert torch.equal(image, before[0])
    assert torch.equal(target, before[1])


@pytest.mark.parametrize(
    ("image", "target", "message"),
    [
        (torch.zeros(3, 4, 5), torch.zeros(3, 5, 4), r"share one shape.*\(3, 4, 5\) and \(3, 5, 4\)"),
        (torch.zeros(4, 5), torch.zeros(4, 5), r"\(C, H, W\)"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5).double(), "float32 on cpu and torch.float64"),
        (torch.zeros(3, 4, 5).byte(), torch.zeros(3, 4, 5).byte(), "floating-point"),
        (torch.zeros(3, 4, 5), torch.zeros(3, 4, 5, requires_grad=True), "target.detach"),
    ],
)
def test_wrong_images(image, target, message):
    with pytest.raises(ValueError, match=message):
        ssim_map(image, target)


@pytest.mark.parametrize("variance", [torch.zeros(3, 4, 4), torch.zeros(3, 4, 5).double()])
def test_wrong_variance(variance):
    image = torch.zeros(3, 4, 5)
    for function in (
        lambda: ssim_map(image, image, variance),
        lambda: expected_photometric_loss(image, variance, image),
    ):
        with pytest.raises(ValueError, match=r"variance .*dtype and device"):
            function()


@pytest.mark.parametrize("weight", [-0.1, 1.1, float("nan")])
def test_wrong_weight(weight):
    with pytest.raises(ValueError, match="lambda_dssim"):
        photometric_loss(*pair(4, 4), weight)


def test_a_variance_adds_to_the_contrast_within_the_window():
    image, target = pair(9, 14)
    variance = 0.1 * pair(9, 14, seed=5)[0]
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    line = torch.exp(-offsets.square() / (2 * 1.5**2))
    window = (line[:, None] * line[None] / line.sum() ** 2)[1:10, 1:10]  # around the center, all of a 9 x 9 image
    x, y, v = image[:, :, :9], target[:, :, :9], variance[:, :, :9]
    mx, my = (window * x).sum((1, 2)), (window * y).sum((1, 2))
    vx, vy = (window * x**2).sum((1, 2)) - mx**2, (window * y**2).sum((1, 2)) - my**2
    cov = (window * x * y).sum((1, 2)) - mx * my
    expected_v = (window * v).sum((1, 2))
    expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + expected_v + vy + 9e-4))
    torch.testing.assert_close(ssim_map(x, y, v)[:, 4, 4], expected, atol=1e-13, rtol=0)


def test_gradient_of_the_expected_loss():
    image, target = pair(8, 9)
    variance = 0.1 * pair(8, 9, seed=5)[0]
    leaves = (image.requires_grad_(), variance.requires_grad_())
    assert torch.autograd.gradcheck(lambda x, v: expected_photometric_loss(x, v, target, 0.3), leaves)


def test_without_variance_the_expected_loss_is_the_loss():
    image, target = pair(20, 30)
    expected = expected_photometric_loss(image, torch.zeros_like(image), target, 0.3)
    # The rounding error that the photograph is given adds at most 0.23 / 255 to the absolute error of a pixel.
    assert 0 <= (expected - photometric_loss(image, target, 0.3)).item() < 0.7 * 0.24 / 255


def test_the_expected_loss_is_near_the_mean_over_random_images():
    image, target = pair(60, 80)
    variance = 0.02 * pair(60, 80, seed=5)[0]
    generator = torch.Generator().manual_seed(1)
    losses = torch.stack(
        [
            photometric_loss(image + variance.sqrt() * torch.randn(image.shape, generator=generator).double(), target)
            for _ in range(40)
        ]
    )
    # Pixels are normal here and independent, as the formula takes them; what is left is the curvature of SSIM.
    expected = expected_photometric_loss(image, variance, target).item()
    assert expected == pytest.approx(losses.mean().item(), rel=0.01)
    assert abs(photometric_loss(image, target).item() / losses.mean().item() - 1) > 0.05


def losses_of_others(six, three_views, background):
    images = [render_gaussians(six, view.camera, background).image for view in three_views[1:]]
    return [photometric_loss(x, view.image).item() for x, view in zip(images, three_views[1:], strict=True)]


@pytest.mark.parametrize("n", [2, 3, 9])
def test_the_losses_of_further_views_add_up_and_density_control_sees_them(six, three_views, take_step, n):
    chosen = set()
    for seed in range(12):  # of two views always the same one: once in 2,048
        step = take_step(seed=seed, depth=False)
        one, other = losses_of_others(six, three_views, step.background)
        value = Views(n, 0.5)(step).item()
        sums = {"both": one + other} if n > 2 else {"b": one, "c": other}
        chosen.add(next(names for names, x in sums.items() if value == pytest.approx(0.5 * x, rel=1e-10)))
        assert len(step.observed) == min(n, 3)
        assert step.view.name == "a", "the step is still of its own view"
    assert len(chosen) == (2 if n == 2 else 1)


def test_every_view_has_a_draw_of_its_own(take_step):
    chain = Chain(GaussianDropout(0.5))
    keeps = set()
    step = take_step(depth=False, regularizer=chain)
    for view in step.views:
        other = step.at(view)
        keeps.add(tuple(chain.keep.tolist()))
        assert torch.equal(other.image, step.at(view).image), "which is the same when taken again"
    assert len(keeps) > 1  # false once in 4,096 seeds


def test_an_analytic_step_takes_the_expectation_at_every_view(tiny_scene):
    config = TrainConfig(iterations=1, dropout=0.3, analytic=True, loss="photometric + views(2)")
    trainer = Trainer(tiny_scene, config)
    seen, sizes = trainer.losses[1], []
    original = seen.photometric
    seen.photometric = lambda step: sizes.append(step.variance) or original(step)
    trainer.train()
    assert len(sizes) == 1
    assert sizes[0].max() > 0


def test_gradients(assert_gradients_of_differences):
    assert_gradients_of_differences(Views(3, 0.7, lambda_dssim=0.0), "means", "opacity_logits")


def test_arguments():
    for text, message in (
        ("views(1)", "n must be at least 2, got 1: one view is what photometric has"),
        ("views(2.5)", r"'views\(2\.5\)': n must be an integer, got float"),
        ("views(2, -1.0)", "weight must"),
        ("views(2, 1.0, 2.0)", "lambda_dssim"),
    ):
        with pytest.raises(ValueError, match=message):
            LOSSES.make(text)
