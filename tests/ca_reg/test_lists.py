"""Moments from per-pixel lists, against padded lists, the renderer, and closed forms."""

import itertools
from typing import NamedTuple

import pytest
import torch
from oracles import brute_force, random_scene
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier, alpha_moments, contributions, pixel_moments
from ca_reg.lists import ListMoments, PixelLists
from reference_trainer.render import splat
from reference_trainer.render.renderer import render_moments

HEIGHT, WIDTH, N = 3, 5, 12
SIZE = HEIGHT * WIDTH
CLOSE = {"rtol": 1e-12, "atol": 1e-15}


class Padded(NamedTuple):
    """Every Gaussian in every pixel, each pixel in an order of its own; an alpha of 0 where it does not reach."""

    falloff: Tensor
    order: Tensor
    opacity: Tensor
    colors: Tensor
    background: Tensor

    @property
    def alphas(self):
        return self.opacity[self.order] * self.falloff

    def lists(self, opacity, view, background=True):
        """The entries that are not 0, rank by rank: the nearest of all pixels first, the pixels shuffled anew each."""
        g = torch.Generator().manual_seed(5)
        pixels = torch.cat([torch.randperm(SIZE, generator=g) for _ in range(N)]).to(self.order.device)
        ranks = torch.arange(N, device=pixels.device).repeat_interleave(SIZE)
        reached = self.falloff[pixels, ranks] > 0
        pixels, ranks = pixels[reached], ranks[reached]
        gaussians = self.order[pixels, ranks]
        alphas = opacity.flatten()[gaussians] * self.falloff[pixels, ranks]
        behind = self.background if background else None
        return PixelLists(gaussians, pixels, alphas, self.colors, HEIGHT, WIDTH, behind)

    def without_background(self, opacity, view):
        return self.lists(opacity, view, background=False)

    def multiplier(self, multiplier):
        """The multiplier with its moments per entry."""
        return Multiplier(
            *(
                x.to(self.order.device).flatten()[self.order] if isinstance(x, Tensor) else x
                for x in (multiplier.mean, multiplier.variance)
            )
        )


def padded(seed=0, dtype=torch.float64, device="cpu"):
    g = torch.Generator().manual_seed(seed)
    falloff = torch.rand(SIZE, N, generator=g, dtype=torch.float64)
    reach = torch.rand(SIZE, 1, generator=g, dtype=torch.float64).square()  # lists of very different lengths
    reach[SIZE // 2] = 0.0
    falloff = falloff * (torch.rand(SIZE, N, generator=g, dtype=torch.float64) < reach)
    order = torch.rand(SIZE, N, generator=g).argsort(1)
    rest = (torch.rand(*shape, generator=g, dtype=torch.float64) for shape in ((N,), (N, 3), (3,)))
    return Padded(falloff.to(device, dtype), order.to(device), *(x.to(device, dtype) for x in rest))


def uniform(seed, *shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


MULTIPLIERS = {
    "numbers": Multiplier.dropout(0.3),
    "(N,)": Multiplier(uniform(1, N), uniform(2, N)),
    "(N, 1)": Multiplier(uniform(1, N, 1), uniform(2, N, 1)),
    "mixed": Multiplier(0.7, uniform(2, N)),
}
DROPOUT = MULTIPLIERS["numbers"]


def image(pixels):
    return pixels.T.reshape(3, HEIGHT, WIDTH)


@pytest.mark.parametrize("multiplier", MULTIPLIERS.values(), ids=MULTIPLIERS.keys())
def test_scrambled_lists_equal_padded_ones(multiplier, device):
    scene = padded(device=device)
    assert (scene.falloff > 0).sum(1).unique().numel() > 4
    out = ListMoments(scene.lists)(scene.opacity, None, multiplier, None)
    per_entry = scene.multiplier(multiplier)
    expected = pixel_moments(scene.alphas, scene.colors[scene.order], per_entry, background=scene.background)
    torch.testing.assert_close(out.mean, image(expected.mean), **CLOSE)
    torch.testing.assert_close(out.variance, image(expected.variance), **CLOSE)
    alpha = alpha_moments(scene.alphas, per_entry).mean.view(HEIGHT, WIDTH)
    torch.testing.assert_close(out.alpha_mean, alpha, **CLOSE)


@pytest.mark.parametrize("shape", [(3,), (3, HEIGHT, WIDTH), None])
def test_the_background_is_the_one_asked_for_else_that_of_the_lists_else_black(shape):
    scene = padded()
    behind = torch.zeros(3, dtype=torch.float64) if shape is None else uniform(7, *shape)
    per_pixel = behind.expand(SIZE, 3) if behind.ndim == 1 else behind.flatten(1).T
    expected = pixel_moments(scene.alphas, scene.colors[scene.order], DROPOUT, background=per_pixel)
    lists_fn = scene.without_background if shape is None else scene.lists
    out = ListMoments(lists_fn)(scene.opacity, None, DROPOUT, None if shape is None else behind)
    torch.testing.assert_close(out.mean, image(expected.mean), **CLOSE)
    torch.testing.assert_close(out.variance, image(expected.variance), **CLOSE)


def dense(seed=0):
    """Twelve entries for every pixel: several chunks, which hold at least four."""
    return padded(seed)._replace(falloff=uniform(4, SIZE, N))


def test_chunks_of_any_size_give_the_same(monkeypatch):
    scene, per_gaussian, weights = dense(), MULTIPLIERS["(N,)"], uniform(3, HEIGHT, WIDTH)
    moments, found = ListMoments(scene.lists), []
    for least in (1, 1000):
        monkeypatch.setattr("ca_reg.lists.CHUNK_ENTRIES", least)
        shares = moments.shares(scene.opacity, None, per_gaussian, None, weights)
        found.append((*moments(scene.opacity, None, per_gaussian, None), shares))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, **CLOSE)


def test_all_masks_of_short_lists():
    """Every subset of up to five Gaussians, dropped at rates of their own, composited one by one."""
    rates = uniform(6, 5)
    falloff = uniform(7, SIZE, 5) * (uniform(8, SIZE, 5) < 0.7)
    colors, behind = uniform(9, 5, 3), uniform(10, 3)
    order = torch.stack([torch.randperm(5, generator=torch.Generator().manual_seed(i)) for i in range(SIZE)])

    def lists_fn(opacity, view):
        pixels, places = (falloff > 0).nonzero().unbind(1)
        return PixelLists(order[pixels, places], pixels, falloff[pixels, places], colors, HEIGHT, WIDTH, behind)

    means = torch.zeros(2, SIZE, 4, dtype=torch.float64)
    for keep in itertools.product((0.0, 1.0), repeat=5):
        keep = torch.tensor(keep, dtype=torch.float64)
        over = torch.cat([behind, behind.new_zeros(1)]).expand(SIZE, 4)
        for place in range(4, -1, -1):
            alpha = (falloff[:, place] * keep[order[:, place]])[:, None]
            shown = torch.nn.functional.pad(colors[order[:, place]], (0, 1), value=1.0)
            over = alpha * shown + (1 - alpha) * over
        probability = torch.where(keep > 0, 1 - rates, rates).prod()
        means += probability * torch.stack([over, over.square()])
    multiplier = Multiplier(1 - rates, rates * (1 - rates))
    found = ListMoments(lists_fn)(torch.ones(5, dtype=torch.float64), None, multiplier, None)
    torch.testing.assert_close(found.mean, image(means[0, :, :3]), **CLOSE)
    torch.testing.assert_close(found.variance, image((means[1] - means[0].square())[:, :3]), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(found.alpha_mean, means[0, :, 3].view(HEIGHT, WIDTH), **CLOSE)


def test_pixels_without_entries_show_the_background_for_certain():
    scene = padded()
    out = ListMoments(scene.lists)(scene.opacity, None, DROPOUT, None)
    y, x = divmod(SIZE // 2, WIDTH)
    assert torch.equal(out.mean[:, y, x], scene.background)
    assert out.variance[:, y, x].tolist() == [0.0, 0.0, 0.0]
    assert out.alpha_mean[y, x] == 0.0


@pytest.mark.parametrize("n", [0, 2])
def test_lists_may_be_empty(n):
    none = torch.zeros(0, dtype=torch.int64)
    background = torch.tensor([0.1, 0.2, 0.3])
    moments = ListMoments(lambda o, v: PixelLists(none, none, torch.zeros(0), torch.ones(n, 3), 2, 4, background))
    out = moments(torch.ones(n), None, DROPOUT, None)
    assert torch.equal(out.mean, background[:, None, None].expand(3, 2, 4))
    assert torch.equal(out.variance, torch.zeros(3, 2, 4))
    assert torch.equal(out.alpha_mean, torch.zeros(2, 4))
    shares = moments.shares(torch.ones(n), None, DROPOUT, None, torch.ones(2, 4))
    assert torch.equal(shares, torch.zeros(n, dtype=torch.float64))


def test_shares_are_the_contributions_added_up_by_gaussian():
    scene, weights = padded(), uniform(3, HEIGHT, WIDTH)
    scene.falloff[scene.order == 4] = 0.0  # number 4 is in no list
    shares = ListMoments(scene.lists).shares(scene.opacity[:, None], None, MULTIPLIERS["(N, 1)"], None, weights)
    per_entry = scene.multiplier(MULTIPLIERS["(N, 1)"])
    parts = contributions(scene.alphas, scene.colors[scene.order], per_entry, background=scene.background).mean(-1)
    expected = [(parts * weights.view(-1, 1))[scene.order == i].sum() for i in range(N)]
    torch.testing.assert_close(shares, torch.stack(expected), **CLOSE)
    assert shares[4] == 0.0
    variance = ListMoments(scene.lists)(scene.opacity, None, MULTIPLIERS["(N,)"], None).variance
    torch.testing.assert_close(shares.sum(), (variance.mean(0) * weights).sum(), **CLOSE)


def test_weights_are_the_gradient_of_a_picture_in_its_colors():
    """The mean picture of a factor of 1 is the picture itself, linear in the colors."""
    case = padded(seed=4)
    colors = torch.zeros_like(case.colors).requires_grad_()
    picture = ListMoments(case._replace(colors=colors).lists)(case.opacity, None, Multiplier(1.0, 0.0), None).mean
    (gradient,) = torch.autograd.grad(picture.sum(), colors)
    assert (gradient > 0).any()
    weights = ListMoments(case.lists).weights(case.opacity, None)
    torch.testing.assert_close(weights, gradient[:, 0], **CLOSE)


def test_float32_lists_give_float32_moments_and_float64_shares():
    scene, exact = padded(dtype=torch.float32), padded()
    moments = ListMoments(scene.lists)
    weights = torch.ones(HEIGHT, WIDTH)
    for multiplier in MULTIPLIERS.values():  # float64 tensors in it
        out = moments(scene.opacity, None, multiplier, exact.background)
        expected = ListMoments(exact.lists)(exact.opacity, None, multiplier, None)
        for a, b in zip(out, expected, strict=True):
            assert a.dtype is torch.float32
            torch.testing.assert_close(a, b.float())
        shares = moments.shares(scene.opacity, None, multiplier, None, weights)
        expected = ListMoments(exact.lists).shares(exact.opacity, None, multiplier, None, weights)
        assert shares.dtype is torch.float64
        torch.testing.assert_close(shares.float(), expected.float())


def test_lists_by_brute_force_agree_with_the_renderer():
    scene = random_scene(10, 11, 8, 3, size=0.35)
    depths = (scene.means @ scene.camera.world_to_camera[:3, :3].T + scene.camera.world_to_camera[:3, 3])[:, 2]
    order = depths.argsort()

    def lists_fn(opacity, view):
        one = [x[:, None] for x in (*scene[:3], opacity, scene.colors)]
        alone = torch.stack([brute_force(*(x[i] for x in one), scene.camera)[1].flatten() for i in order.tolist()])
        which, pixels = (alone > 0).nonzero().unbind(1)
        return PixelLists(order[which], pixels, alone[which, pixels], scene.colors, 8, 11)

    def moments_fn(opacity, view, multiplier, background):
        splats = splat(*scene[:3], opacity, scene.camera, colors=scene.colors)
        return render_moments(splats, multiplier, background=background)

    moments, opacity = ListMoments(lists_fn), scene.opacities
    ours, theirs = (f(opacity, None, Multiplier.dropout(0.4), scene.colors[0]) for f in (moments, moments_fn))
    assert (ours.variance > 1e-4).double().mean() > 0.3
    for name in ("mean", "variance", "alpha_mean"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-9, atol=1e-13)
    for neutral in (False, True):
        a, b = (CAScore.exact(f, neutral=neutral, threshold=0.3)(opacity, None) for f in (moments, moments_fn))
        assert torch.equal(a.visible, b.visible)
        assert a.value == pytest.approx(b.value, rel=1e-9)


def test_gradients(monkeypatch):
    monkeypatch.setattr("ca_reg.lists.CHUNK_ENTRIES", 1)
    scene = dense(seed=1)

    def f(opacity, colors, background, mean, variance):
        return tuple(
            ListMoments(scene._replace(colors=colors).lists)(opacity, None, Multiplier(mean, variance), background)
        )

    inputs = (scene.opacity, scene.colors, uniform(4, 3, HEIGHT, WIDTH), uniform(1, N) + 0.1, uniform(2, N) + 0.1)
    assert torch.autograd.gradcheck(f, tuple(x.clone().requires_grad_() for x in inputs), fast_mode=True)


def test_the_callable_itself_is_checked():
    with pytest.raises(TypeError, match="must be callable"):
        ListMoments(None)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"gaussians": torch.tensor([0.0, 1.0])}, TypeError, "gaussians .*int64 or int32"),
        ({"gaussians": torch.tensor([0, 2])}, ValueError, r"gaussians .*\[0, 2\), got .* 0 to 2"),
        ({"gaussians": torch.tensor([-1, 1])}, ValueError, r"in \[0, 2\), got values from -1 to 1"),
        ({"pixels": torch.tensor([0, 6])}, ValueError, r"pixels .*\[0, 6\)"),
        ({"pixels": torch.tensor([0])}, ValueError, r"pixels .*shape of alphas, \(2,\)"),
        ({"alphas": torch.tensor([0.5, 1.5])}, ValueError, r"alphas must be in \[0, 1\]"),
        ({"alphas": torch.ones(2, 1)}, ValueError, r"alphas .*shape \(P,\)"),
        ({"alphas": torch.ones(2).double()}, TypeError, "same dtype"),
        ({"colors": torch.ones(3, 3)}, ValueError, r"colors .*shape \(2, 3\)"),
        ({"height": 0}, ValueError, "height .*at least 1"),
        ({"background": torch.tensor([0.0, torch.nan, 0.0])}, ValueError, "background must be finite"),
        ({"colors": torch.tensor([[0.5] * 3, [torch.inf] * 3])}, ValueError, "colors must be finite"),
        ({"background": torch.ones(4)}, ValueError, r"background .*shape \(3,\) or \(3, 2, 3\)"),
    ],
)
def test_lists_are_checked(change, error, match):
    zero_one = torch.tensor([0, 1])
    lists = PixelLists(zero_one, zero_one, torch.full((2,), 0.5), torch.ones(2, 3), 2, 3)
    ListMoments(lambda o, v: lists)(torch.ones(2), None, DROPOUT, None)
    with pytest.raises(error, match=match):
        ListMoments(lambda o, v: lists._replace(**change))(torch.ones(2), None, DROPOUT, None)


def test_arguments_are_checked():
    scene = padded()
    moments = ListMoments(scene.lists)
    with pytest.raises(ValueError, match=r"opacity .*shape"):
        moments(scene.opacity[None, :], None, DROPOUT, None)
    with pytest.raises(ValueError, match="channels first"):
        moments(scene.opacity, None, DROPOUT, torch.zeros(HEIGHT, WIDTH, 3))
    with pytest.raises(ValueError, match=r"variance .*multiplier .*shape"):
        moments(scene.opacity, None, Multiplier(1.0, torch.ones(N + 1)), None)
    with pytest.raises(ValueError, match=r"weights .*\(3, 5\)"):
        moments.shares(scene.opacity, None, DROPOUT, None, torch.ones(WIDTH, HEIGHT))
    with pytest.raises(TypeError, match=r"ca_reg\.lists\.PixelLists, got tuple"):
        ListMoments(lambda o, v: tuple(scene.lists(o, v)))(scene.opacity, None, DROPOUT, None)
