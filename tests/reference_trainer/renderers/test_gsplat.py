"""The gsplat renderer against this package's own, through a stand-in for the kernels and, on a GPU, through gsplat.

On a machine with a CUDA device: ``pip install 'gsplat>=1.5'``, then this file.
"""

import functools
import sys

import pytest
import torch
from oracles import random_scene
from stand_ins.gsplat import centered, rasterization

from reference_trainer.render import render
from reference_trainer.renderers import BuiltinRenderer
from reference_trainer.renderers.gsplat import load_gsplat_render, render_by
from reference_trainer.training.density.operations import DensityStatistics

N, WIDTH, HEIGHT = 80, 40, 24
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])

by_stand_in = functools.partial(render_by, rasterization)


def own(means, quaternions, scales, opacities, camera, **options):
    given = {"means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "camera": camera}
    return BuiltinRenderer()(**given, **options)


def scene_of(device="cpu"):
    return centered(random_scene(N, WIDTH, HEIGHT, seed=8).to(torch.float32, device))


def rendered(renderer, scene, **options):
    """A rendering, and the gradients of a loss that is different at every pixel."""
    leaves = [x.clone().requires_grad_() for x in scene.tensors()]
    *geometry, colors = leaves
    colored = options if "sh" in options else options | {"colors": colors}
    out = renderer(*geometry, scene.camera, background=BACKGROUND.to(colors), **colored)
    g = torch.Generator().manual_seed(1)
    weights = torch.randn(4, HEIGHT, WIDTH, generator=g).to(colors)
    loss = (out.image * weights[:3]).sum() + (out.alpha * weights[3]).sum()
    if out.depth is not None:
        loss = loss + (out.depth * weights[0]).sum()
    loss.backward()
    return out, [x.grad for x in leaves if x.grad is not None]


def counted(out, camera):
    """What the trainer enters into the densification statistics."""
    statistics = DensityStatistics.zeros(N, out.image.device)
    indices, touched, gradient = out.splats.indices, out.splats.touched, out.splats.means.grad
    statistics.update(indices, touched, gradient, camera.width, camera.height)
    return statistics


def compare(one, other, camera, **close):
    (ours, our_gradients), (theirs, their_gradients) = one, other
    for name in ("image", "alpha"):
        torch.testing.assert_close(getattr(theirs, name), getattr(ours, name), **close)
    scale = max(float(x.abs().max()) for x in our_gradients)
    for x, y in zip(their_gradients, our_gradients, strict=True):
        torch.testing.assert_close(x / scale, y / scale, **close)
    mine, its = counted(ours, camera), counted(theirs, camera)
    torch.testing.assert_close(its.gradient_sum / scale, mine.gradient_sum / scale, **close)
    seen = mine.steps > 0
    assert 20 < seen.sum() < N
    assert (its.steps[seen] == 1).all()
    # gsplat's lists are rectangles: they also hold what touches the picture's tiles, but renders nothing there.
    assert not its.gradient_sum[(its.steps > 0) & ~seen].any()


@pytest.mark.parametrize("options", [{}, {"depth": True}], ids=["image", "depth"])
def test_image_gradients_and_statistics_are_those_of_the_own_renderer(options):
    scene = scene_of()
    ours, theirs = (rendered(renderer, scene, **options) for renderer in (render, by_stand_in))
    compare(ours, theirs, scene.camera, rtol=1e-5, atol=1e-6)
    if options:
        torch.testing.assert_close(theirs[0].depth, ours[0].depth)
    assert type(theirs[0])._fields == type(ours[0])._fields


def test_harmonics_and_dropped_gaussians():
    scene = scene_of()
    scene = scene._replace(opacities=torch.where(torch.arange(N) % 3 > 0, scene.opacities, 0.0))
    sh = torch.randn(N, 9, 3, generator=torch.Generator().manual_seed(3)) / 4
    for degree in (None, 1):
        ours, theirs = (rendered(renderer, scene, sh=sh, sh_degree=degree) for renderer in (render, by_stand_in))
        torch.testing.assert_close(theirs[0].image, ours[0].image)
    assert (theirs[0].splats.indices % 3 > 0).all()


def test_without_gradients_nothing_is_retained():
    scene = scene_of()
    with torch.no_grad():
        out = by_stand_in(*scene[:4], scene.camera, colors=scene.colors)
    assert not out.splats.means.requires_grad
    assert out.depth is None


def test_the_constants_are_those_of_the_own_renderer():
    given = {}

    def spy(**kwargs):
        given.update(kwargs)
        return rasterization(**kwargs)

    scene = scene_of()
    render_by(spy, *scene[:4], scene.camera, colors=scene.colors)
    assert (given["near_plane"], given["eps2d"], given["packed"]) == (0.2, 0.3, True)


def test_absolute_gradients_are_left_where_density_control_looks():
    """Of gsplat's interface over the own renderer: the sums have a test of their own, here they are passed on."""
    scene, sums = scene_of(), []
    for renderer in (own, by_stand_in):
        splats = rendered(renderer, scene, absgrad=True)[0].splats
        assert (splats.means.absgrad >= splats.means.grad.abs() * (1 - 1e-4) - 1e-6).all()
        sums.append(torch.zeros(N, 2).index_copy(0, splats.indices, splats.means.absgrad))
    torch.testing.assert_close(*sums)
    assert sums[0].any()


def test_absolute_gradients_without_a_background_are_those_over_black():
    scene, sums = scene_of(), []
    for options in ({}, {"background": torch.zeros(3)}):
        means = scene.means.clone().requires_grad_()
        out = own(means, *scene[1:4], scene.camera, colors=scene.colors, absgrad=True, **options)
        out.image.square().sum().backward()
        sums.append(out.splats.means.absgrad)
    assert torch.equal(*sums)
    assert sums[0].any()


def test_what_is_missing_is_told(monkeypatch):
    with pytest.raises(RuntimeError, match=r"'cpu': .*--device cuda, .*--renderer builtin"):
        load_gsplat_render("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RuntimeError, match="torch finds none"):
        load_gsplat_render("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"pip install 'ca_reg\[gsplat\]'"):
        load_gsplat_render("cuda")


def test_wrong_arguments_are_told():
    scene = scene_of()
    with pytest.raises(ValueError, match="either sh"):
        by_stand_in(*scene[:4], scene.camera)
    with pytest.raises(TypeError, match=r"float32 only, got torch\.float64"):
        by_stand_in(scene.means.double(), *scene[1:4], scene.camera, colors=scene.colors)


@pytest.mark.gpu
@pytest.mark.parametrize("options", [{}, {"depth": True}], ids=["image", "depth"])
def test_gsplat_itself_renders_the_same(options):
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    pytest.importorskip("gsplat", exc_type=ImportError)
    scene = scene_of("cuda")
    ours, theirs = (rendered(renderer, scene, **options) for renderer in (render, load_gsplat_render("cuda")))
    # A pair on the edge of 1/255 may be rendered by one and not by the other.
    compare(ours, theirs, scene.camera, rtol=1e-2, atol=5e-3)
