"""The base class of the renderers of the training views, and this package's own."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import torch

from reference_trainer.render.densification import absgrad_sink, with_absolute_gradients
from reference_trainer.render.renderer import render

__all__ = ["BuiltinRenderer", "Renderer"]


class Renderer(abc.ABC):
    """Renders Gaussians, with the arguments of `reference_trainer.render.render`; custom renderers are subclasses.

    Attributes:
        capabilities: besides image and alpha: ``"depth"``; ``"moments"`` if `reference_trainer.render.render_moments`
            renders the same picture, which analytic training and terms that render moments need; ``"absgrad"`` if it
            takes ``absgrad=True``, with which the backward pass leaves the sums of absolute gradients (M, 2) in
            ``splats.means.absgrad``.
    """

    capabilities: ClassVar[frozenset[str]] = frozenset()

    def prepare(self, device: torch.device) -> None:  # noqa: B027
        """Load what is needed to render on a device.

        Raises:
            ImportError: if something is missing.
            RuntimeError: if it cannot render there.
        """

    @abc.abstractmethod
    def __call__(self, **arguments: Any) -> Any:
        """Return a `Rendering`, or an object with those fields that training reads: see `GsplatRendering`."""


class BuiltinRenderer(Renderer):
    """This package's renderer, with the chosen engine."""

    capabilities = frozenset({"depth", "moments", "absgrad"})

    def __call__(self, *, absgrad: bool = False, **arguments: Any) -> Any:
        """Render."""
        out = render(**arguments)
        # Without gradients there is nothing to take absolute values of.
        if absgrad and out.splats.projection.means.requires_grad:
            sink = absgrad_sink(out.splats.projection.means)
            return with_absolute_gradients(out, sink, arguments.get("background"))
        return out
