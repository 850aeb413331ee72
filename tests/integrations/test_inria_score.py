"""The score of INRIA-style models: opacities from outside, alpha from wherever it is."""

import sys
import threading
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render
from torch import nn

from ca_reg import CAScore, GaussianDropout
from ca_reg.integrations.inria import RasterizerHook, render_fn
from reference_trainer.render import render as reference_render

FORMS = ["plain", "inverse-depth", "weights", "depth-alpha", "coordinates"]
BACKGROUND = torch.tensor([0.3, 0.1, 0.7])


class Settings(NamedTuple):
    bg: torch.Tensor
    image_height: int
    image_width: int


def reference(model):
    """The same renders without any of the family's interfaces."""

    def render(opacity, camera):
        arguments = model.get_xyz, model.get_rotation, model.get_scaling, opacity, camera
        out = reference_render(*arguments, colors=model.get_features, background=BACKGROUND)
        return out.image, out.alpha

    return render


@pytest.mark.parametrize(("form", "named"), [*((form, False) for form in FORMS), ("depth-alpha", True)])
def test_the_score_is_that_of_the_plain_renderer(form, named):
    model, rasterizer = Model(), make_rasterizer(form)
    fn = render_fn(make_render(rasterizer, named), model, PIPE, BACKGROUND, rasterizer=rasterizer)
    forward = vars(rasterizer)["forward"]
    opacity = model.get_opacity.detach()
    result, expected = (CAScore(f, samples=4, threshold=0.1)(opacity, model.camera) for f in (fn, reference(model)))
    assert expected.value > 0
    torch.testing.assert_close(result.variance, expected.variance, rtol=1e-4, atol=1e-9)
    assert torch.equal(result.visible, expected.visible)
    assert vars(rasterizer)["forward"] is forward


def test_an_installed_hook_does_not_touch_scores_nor_lose_its_place(monkeypatch):
    model, rasterizer = Model(), make_rasterizer()
    render = make_render(rasterizer)
    opacity = model.get_opacity.detach()
    expected = reference(model)(opacity, model.camera)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        hook.step(1)
        image, alpha = render_fn(render, model, PIPE, BACKGROUND, rasterizer=rasterizer)(opacity, model.camera)
        assert hook.tally.regularized + hook.tally.scaled == 0
        render(model.camera, model, PIPE, BACKGROUND)
        assert hook.tally.regularized == 1
    torch.testing.assert_close(image, expected[0])
    torch.testing.assert_close(alpha, expected[1])


def test_renders_of_other_threads_keep_their_own_opacities():
    """Two scores and a plain render at once; the scores end in the order in which they began."""
    model, rasterizer = Model(), make_rasterizer()
    forward, render = vars(rasterizer)["forward"], make_render(rasterizer)
    opacity = model.get_opacity.detach()
    expected = [reference(model)(factor * opacity, model.camera)[0] for factor in (1.0, 0.5, 0.25)]
    inside = [threading.Event() for _ in range(2)]
    done = [threading.Event() for _ in range(2)]
    found = {}

    def score(number):
        def slow(*arguments):
            package = render(*arguments)
            inside[number].set()
            assert done[number].wait(timeout=30)
            return package

        fn = render_fn(slow, model, PIPE, BACKGROUND, rasterizer=rasterizer)
        found[number] = fn(expected_factor[number] * opacity, model.camera)[0]

    expected_factor = (0.5, 0.25)
    threads = [threading.Thread(target=score, args=(number,)) for number in range(2)]
    for number, thread in enumerate(threads):
        thread.start()
        assert inside[number].wait(timeout=30)
    plain = render(model.camera, model, PIPE, BACKGROUND)["render"]
    for number, thread in enumerate(threads):
        done[number].set()
        thread.join()
    for image, wanted in zip((plain, found[0], found[1]), expected, strict=True):
        torch.testing.assert_close(image, wanted)
    assert vars(rasterizer)["forward"] is forward


def test_installed_rasterizers_are_found(monkeypatch):
    model, rasterizer = Model(), make_rasterizer()
    monkeypatch.setitem(sys.modules, "diff_gaussian_rasterization", SimpleNamespace(GaussianRasterizer=rasterizer))
    fn = render_fn(make_render(rasterizer), model, PIPE, BACKGROUND)
    assert fn(model.get_opacity.detach(), model.camera).alpha.shape == (24, 32)


def test_what_cannot_be_scored_is_said():
    model, rasterizer = Model(), make_rasterizer()
    opacity = model.get_opacity.detach()
    other = render_fn(make_render(make_rasterizer()), model, PIPE, BACKGROUND, rasterizer=rasterizer)
    with pytest.raises(RuntimeError, match="0 times, expected once"):
        other(opacity, model.camera)
    fn = render_fn(make_render(rasterizer), model, PIPE, BACKGROUND, rasterizer=rasterizer)
    with pytest.raises(ValueError, match=r"60 Gaussians, .*59 opacities"):
        fn(opacity[1:], model.camera)


def test_an_alpha_is_not_measured_where_colors_cannot_be_given():
    class Rasterizer(nn.Module):
        def __init__(self, settings):
            super().__init__()
            self.raster_settings = settings

        def forward(self, means3D, means2D, opacities, features):
            return features.mean(0)[:, None, None].expand(3, 24, 32), torch.ones(len(means3D), dtype=torch.int32)

    model, settings = Model(), Settings(BACKGROUND, 24, 32)

    def render(camera, gaussians, pipe, background):
        return {"render": Rasterizer(settings)(gaussians.get_xyz, None, gaussians.get_opacity, torch.rand(60, 3))[0]}

    fn = render_fn(render, model, PIPE, BACKGROUND, rasterizer=Rasterizer)
    with pytest.raises(ValueError, match=r"Rasterizer .*colors_precomp.*named alpha"):
        fn(model.get_opacity.detach(), model.camera)
