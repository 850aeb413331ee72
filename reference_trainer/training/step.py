"""One training step: its view, its render, and the means for loss terms to render more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
from torch import Tensor

from ca_reg import Chain, Params
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import render_gaussians, render_moments_of
from reference_trainer.render import MomentImages, Rendering, ViewSplats
from reference_trainer.scenes.scene import View
from reference_trainer.training.randomness import stream

__all__ = ["Step", "read_later"]


def read_later(x: Tensor) -> Callable[[], float]:
    """Start to copy a number to the host; return a function that waits for the copy, not for work launched after it.

    Example:
        >>> read_later(torch.tensor(0.5))()
        0.5
    """
    if x.device.type != "cuda":
        return x.item
    # Into pinned memory, which PyTorch takes by itself: the host goes on launching.
    copied = x.to("cpu", non_blocking=True)
    done = torch.cuda.current_stream(x.device).record_event()

    def read() -> float:
        done.synchronize()
        return copied.item()

    return read


@dataclass(eq=False, repr=False)
class Step:
    """One training step: its view, its render, and the means for loss terms to render more.

    The trainer calls `sample` or `expect`, which set ``image``; then every term of the loss reads from
    the step, and renders with `render` and `moments` whatever else it compares.

    Args:
        number: of the step, the first being 0.
        view: the training view, on the model's device, over the background of this step.
        views: all training views.
        gaussians: the model.
        regularizer: the regularizers that act in this step; an empty chain if none do.
        background: color behind the model, shape (3,).
        photographed_over: color behind ``views``.
        sh_degree: highest band of spherical harmonics of this step.
        seed: of the training.
        renderer: what renders.
        absgrad: whether density control is to see absolute gradients.
        label: prefix of the labels of the random streams.
        siblings: the steps of all models at this view, this one among them, the first model's first.

    Attributes:
        params: the activated parameters, with the view's camera, before any regularizer.
        rendered: the same after the regularizer; in an analytic step, what the expectation was rendered with.
        image: the render, or in an analytic step its expectation, not clamped, shape (3, H, W).
        variance: of the colors in an analytic step, shape (3, H, W); None in others.
        rendering: the render with alpha, depth if a term needs it, and splats; None in an analytic step.
        observed: splats and camera of every render that density control is to count.
    """

    number: int
    view: View
    views: Sequence[View]
    gaussians: Gaussians
    regularizer: Chain
    background: Tensor
    _: KW_ONLY
    photographed_over: Tensor
    sh_degree: int
    seed: int
    renderer: Callable[..., Any]
    absgrad: bool = False
    label: str = ""
    siblings: Sequence[Step] = ()
    image: Tensor = field(init=False)
    rendered: Params = field(init=False)
    variance: Tensor | None = field(default=None, init=False)
    rendering: Rendering | None = field(default=None, init=False)
    observed: list[tuple[ViewSplats, Camera]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        # Activated once for all terms: they share its graph.
        self.params = self.gaussians.params(self.view.camera, step=self.number)

    @property
    def depth(self) -> Tensor:
        """Depth of the step's render, if a term needs it: sum of weight times depth, shape (H, W)."""
        depth = None if self.rendering is None else self.rendering.depth
        assert depth is not None, "no term of the loss needs it"
        return depth

    def sample(self, *, depth: bool) -> None:
        """Render the view with one draw of the regularizer."""
        self.rendered = self.regularizer.regularize(self.params, self.generator("regularizer"))
        self.rendering = self.render(self.view.camera, self.rendered, depth=depth, observed=True)
        self.image = self.rendering.image

    def expect(self) -> None:
        """Render the view in expectation over the draws of the regularizer."""
        factored = self.regularizer.alpha_factor(self.params)
        assert factored is not None, "the trainer has refused this"
        self.rendered, multiplier = factored
        moments = self.moments(self.view.camera, multiplier, self.rendered, observed=True)
        self.image, self.variance = moments.mean, moments.variance

    def at(self, view: View) -> Step:
        """Return the step at another training view, rendered as this one was but with random numbers of its own.

        Density control counts it as it counts the view of the step.
        """
        # A shallow copy: `observed` is one list, so density control sees the renders of both.
        other = copy(self)
        other.view = view.over(self.background, self.photographed_over)
        other.params = self.gaussians.params(view.camera, step=self.number)
        other.label += f"{view.name}/"
        if self.rendering is None:
            other.expect()
        else:
            other.sample(depth=False)
        return other

    def render(
        self, camera: Camera, params: Params | None = None, *, depth: bool = False, observed: bool = False
    ) -> Rendering:
        """Render a camera with the model of this step.

        Args:
            camera: on the model's device.
            params: what to render, by default the plain model.
            depth: whether to accumulate depth.
            observed: whether density control is to count it as it counts the view of the step.
        """
        out = render_gaussians(
            self.params if params is None else params,
            camera,
            self.background,
            sh_degree=self.sh_degree,
            depth=depth,
            absgrad=observed and self.absgrad,
            renderer=self.renderer,
        )
        # The projected centers have no gradient yet: the trainer hands them on after the backward pass.
        if observed:
            self.observed.append((out.splats, camera))
        return out

    def moments(
        self, camera: Camera, multiplier: Multiplier, params: Params | None = None, *, observed: bool = False
    ) -> MomentImages:
        """Render the exact mean and variance of a camera's colors under random factors on the alphas.

        Args:
            camera: on the model's device.
            multiplier: moments of the factor.
            params: what to render, by default the plain model.
            observed: as for `render`.
        """
        params = self.params if params is None else params
        moments, splats = render_moments_of(params, multiplier, camera, self.background, sh_degree=self.sh_degree)
        if observed:
            self.observed.append((splats, camera))
        return moments

    def generator(self, purpose: str) -> torch.Generator:
        """Return a generator that depends on seed, step and label alone: a resumed training draws the same numbers."""
        return stream(self.seed, self.number, self.label + purpose, self.gaussians.means.device)
