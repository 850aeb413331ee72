"""The base class of the renderers of the training views."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import torch

__all__ = ["Renderer"]


class Renderer(abc.ABC):
    """Draws Gaussians, with the arguments of `reference_trainer.render.render`; custom renderers are subclasses.

    Attributes:
        capabilities: besides image and alpha: ``"depth"``; ``"moments"`` if `reference_trainer.render.render_moments`
            draws the same picture, which analytic training and terms that render moments need; ``"absgrad"`` if it
            takes ``absgrad=True``, with which the backward pass leaves the sums of absolute gradients (M, 2) in
            ``splats.means.absgrad``.
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
