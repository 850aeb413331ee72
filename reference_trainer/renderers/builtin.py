"""This package's own renderer."""

from __future__ import annotations

from typing import Any

from reference_trainer.render.absolute import absgrad_sink, with_absolute_gradients
from reference_trainer.render.renderer import render
from reference_trainer.renderers.renderer import Renderer

__all__ = ["BuiltinRenderer"]


class BuiltinRenderer(Renderer):
    """This package's renderer, with the chosen engine."""

    capabilities = frozenset({"depth", "moments", "absgrad"})

    def __call__(self, *, absgrad: bool = False, **arguments: Any) -> Any:
        """Draw."""
        out = render(**arguments)
        if absgrad and out.splats.projection.means.requires_grad:
            sink = absgrad_sink(out.splats.projection.means)
            return with_absolute_gradients(out, sink, arguments.get("background"))
        return out
