"""The renderers of the training views: the base class, this package's renderer, and gsplat's kernels."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import torch

from reference_trainer.render.absolute import absgrad_sink, with_absolute_gradients
from reference_trainer.render.renderer import render
from reference_trainer.renderers.gsplat import load_gsplat_render

__all__ = ["GsplatRenderer", "OwnRenderer", "Renderer"]


class Renderer(abc.ABC):
    """Draws Gaussians, with the arguments of `reference_trainer.render.render`; custom renderers are subclasses.

    Attributes:
        capabilities: besides image and alpha: ``"depth"``; ``"moments"`` if `reference_trainer.render.render_moments`
            draws the same picture, which analytic training and terms that render moments need; ``"absgrad"`` if it
            takes ``absgrad=True``, with which the backward pass leaves the sums of absolute gradients (M, 2) in
            ``splats.projection.means.absgrad``.
    """

    capabilities: ClassVar[frozenset[str]] = frozenset()

    def prepare(self, device: torch.device) -> None:  # noqa: B027
        """Load what is needed to draw on a device.

        Raises:
            ImportError: if something is missing.
            RuntimeError: if it cannot draw there.
        """

    @abc.abstractmethod
    def __call__(self, **arguments: Any) -> Any:
        """Return a `Rendering`, or an object with those fields that training reads: see `GsplatRendering`."""


class OwnRenderer(Renderer):
    """This package's renderer, with the chosen engine."""

    capabilities = frozenset({"depth", "moments", "absgrad"})

    def __call__(self, *, absgrad: bool = False, **arguments: Any) -> Any:
        """Draw."""
        out = render(**arguments)
        if absgrad and out.splats.projection.means.requires_grad:
            sink = absgrad_sink(out.splats.projection.means)
            return with_absolute_gradients(out, sink, arguments.get("background"))
        return out


class GsplatRenderer(Renderer):
    """gsplat's CUDA kernels."""

    capabilities = frozenset({"depth", "absgrad"})

    def prepare(self, device: torch.device) -> None:
        """Load gsplat."""
        self._render = load_gsplat_render(device)

    def __call__(self, **arguments: Any) -> Any:
        """Draw."""
        return self._render(**arguments)
