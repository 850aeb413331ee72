"""The plug-in on a device that is not the processor: it draws, scores and differentiates there, and says the same."""

from contextlib import nullcontext

import pytest
import torch
from stand_ins.card import counted_synchronizations

from ca_reg import CAMonitor, CAPenalty, CAScore, GaussianDropout, OpacityNoise, attribute
from ca_reg.functional import Multiplier
from ca_reg.lists import ListMoments, PixelLists
from ca_reg.regularizers import parse
from ca_reg.result import summarize
from reference_trainer.training.randomness import deterministic

N, SIDE = 24, 4


class Scene:
    """Every Gaussian reaches every pixel, in an order of its own; blended as a renderer does."""

    def __init__(self, device):
        g = torch.Generator().manual_seed(0)
        self.order = torch.rand(SIDE**2, N, generator=g).argsort(1).to(device)
        self.falloff = torch.rand(SIDE**2, N, generator=g, dtype=torch.float64).to(device)
        self.colors = torch.rand(N, 3, generator=g, dtype=torch.float64).to(device)
        self.opacity = torch.rand(N, generator=g, dtype=torch.float64).to(device)

    def alphas(self, opacity):
        return opacity.flatten()[self.order] * self.falloff

    def render(self, opacity, view):
        alphas = self.alphas(opacity)
        weights = alphas * torch.cumprod(torch.nn.functional.pad(1 - alphas[:, :-1], (1, 0), value=1.0), 1)
        image = (weights[..., None] * self.colors[self.order]).sum(1)
        return image.T.reshape(3, SIDE, SIDE), weights.sum(1).reshape(SIDE, SIDE)

    def lists(self, opacity, view):
        pixels = torch.arange(SIDE**2, device=opacity.device)[:, None].expand(-1, N)
        alphas = self.alphas(opacity)
        return PixelLists(self.order.flatten(), pixels.flatten(), alphas.flatten(), self.colors, SIDE, SIDE)


@pytest.fixture
def scenes(card):
    return Scene("cpu"), Scene(card)


@pytest.mark.parametrize("regularizer", [GaussianDropout(0.3), OpacityNoise(0.8), OpacityNoise(0.8, scale=True)])
@pytest.mark.parametrize("column", [False, True])
def test_regularizers_draw_where_the_opacities_are(scenes, card, regularizer, column):
    torch.manual_seed(0)
    opacity = scenes[1].opacity[:, None] if column else scenes[1].opacity
    for generator in (None, torch.Generator(card).manual_seed(1)):
        drawn = regularizer.train()(opacity, generator=generator)
        assert (drawn.device.type, drawn.shape) == (card.type, opacity.shape)
        assert not torch.equal(drawn, opacity)
    plain = scenes[0].opacity[:, None] if column else scenes[0].opacity
    assert torch.equal(regularizer.eval()(opacity).cpu(), regularizer(plain))


def test_radii_of_dropped_gaussians_are_zeroed_there(scenes, card):
    dropout = GaussianDropout(0.3)
    dropped = dropout(scenes[1].opacity) == 0
    assert torch.equal(dropout.mask_radii(torch.ones(N, device=card)) == 0, dropped)


@pytest.mark.parametrize("kind", ["protocol", "until it is known", "exact", "neutral"])
def test_scores_are_those_of_the_processor(scenes, kind):
    """Its masks do not depend on the device, and nothing is copied to the card."""
    found = []
    for scene in scenes:
        score = {
            "protocol": lambda s: CAScore(s.render, threshold=0.1),
            "until it is known": lambda s: CAScore.adaptive(s.render, threshold=0.1, relative_error=0.2),
            "exact": lambda s: CAScore.exact(ListMoments(s.lists), threshold=0.1),
            "neutral": lambda s: CAScore.exact(ListMoments(s.lists), threshold=0.1, neutral=True),
        }[kind](scene)
        with counted_synchronizations() as waits:
            score.update(scene.opacity, None)
        found.append(score.compute().value)
    read = {"protocol": 1, "exact": 1, "neutral": 2}.get(kind, 0)  # the sums of its error; the lists' sizes
    assert waits["aten::copy_"] + waits["aten::_to_copy"] == read
    assert found[0] > 0
    assert found[1] == pytest.approx(found[0], rel=1e-12)


@pytest.mark.parametrize("exact", [False, True])
def test_a_score_goes_on_under_another_default_device(scenes, card, exact):
    """As after ``torch.set_default_device("cuda")``."""
    scene = scenes[1]
    score = CAScore.exact(ListMoments(scene.lists), threshold=0.1) if exact else CAScore(scene.render, threshold=0.1)
    first = score.update(scene.opacity, None)
    with card:
        second = score.update(scene.opacity, None)
        assert summarize([first, second]) == score.compute()
    assert score.compute().value == pytest.approx((first.value + second.value) / 2, rel=1e-15)


@pytest.mark.parametrize("repeatable", [False, True])
def test_shares_and_penalty_have_the_gradients_of_the_processor(scenes, card, repeatable):
    """Also where a user asks PyTorch for algorithms that repeat themselves: none of it lacks one on CUDA."""
    shares, gradients = [], []
    for scene in scenes:
        moments, opacity = ListMoments(scene.lists), scene.opacity.clone().requires_grad_()
        score = CAScore.exact(moments, threshold=0.1)
        shares.append(attribute(score, moments.shares, scene.opacity, None)[0].cpu())
        with deterministic(card) if repeatable else nullcontext():
            image, _, term = CAPenalty(moments, Multiplier.dropout(0.2))(opacity, None)
            (image.square().mean() + term).backward()
        gradients.append(opacity.grad.cpu())
    torch.testing.assert_close(shares[1], shares[0], rtol=1e-12, atol=0.0)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-12, atol=0.0)


def test_a_monitor_logs_what_is_there(scenes, tmp_path):
    scene = scenes[1]
    with CAMonitor(CAScore(scene.render, threshold=0.1), tmp_path, views={"train": [None]}, every=1) as monitor:
        assert monitor(1, scene.opacity)["ca/train"] > 0


@pytest.mark.parametrize("train", [True, False])
@pytest.mark.parametrize(
    "text", ["dropout(0.2)", "dropout(0.2, compensate=True)", "noise(0.8)", "noise(0.8, scale=True)"]
)
def test_autocast_changes_nothing(card, text, train):
    """Neither values nor gradients, on the processor and on the card."""
    opacity = torch.rand(500, 1, generator=torch.Generator().manual_seed(0))
    for device in ("cpu", card):
        found = []
        for enabled in (False, True):
            x, regularizer = opacity.to(device, copy=True).requires_grad_(), parse(text).train(train)
            with torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=enabled):
                out = regularizer(x, generator=torch.Generator().manual_seed(1))
            out.square().sum().backward()
            found.append((out.detach().cpu(), x.grad.cpu()))
        assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
