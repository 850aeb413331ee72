"""Sums of absolute gradients, of colors, depth and accumulated alpha, against the gradients of one pixel at a time."""

import torch
from oracles import random_scene

from reference_trainer.render import rasterize, render, splat
from reference_trainer.render.absolute import with_absolute_gradients

WIDTH, HEIGHT = 13, 9  # more than one tile, not of whole tiles


def picture(rendering):
    return torch.cat([rendering.image, rendering.depth[None], rendering.alpha[None]])


def test_every_pixel_adds_the_absolute_value_of_its_gradient(case):
    exact = random_scene(30, WIDTH, HEIGHT, seed=21, size=0.2)
    upstream = torch.randn(5, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    background = torch.tensor([0.3, 0.1, 0.8], dtype=torch.float64)
    splats = splat(*exact[:4], exact.camera, colors=exact.colors)
    means = splats.projection.means.detach().requires_grad_()
    moved = splats._replace(projection=splats.projection._replace(means=means))
    of_pixels = (picture(rasterize(moved, background=background, depth=True)) * upstream).sum(0).flatten()
    each = torch.stack([torch.autograd.grad(x, means, retain_graph=True)[0] for x in of_pixels])

    scene = exact.to(case.dtype)
    rendering = render(*scene[:4], scene.camera, colors=scene.colors, background=background.to(case.dtype), depth=True)
    sink = torch.zeros_like(rendering.splats.projection.means).requires_grad_()
    out = with_absolute_gradients(rendering, sink, background.to(case.dtype))
    assert torch.equal(picture(out), picture(rendering))
    (picture(out) * upstream.to(case.dtype)).sum().backward()
    assert rendering.splats.engine.name == case.engine
    case.same_gradient(sink.grad, each.abs().sum(0))
    assert (each.abs().sum(0) > 1.5 * each.sum(0).abs()).any()  # signs differ between the pixels
