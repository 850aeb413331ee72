"""The renderers of the training views, and their registry: what ``--renderer`` knows by name."""

from ca_reg.registry import Registry
from reference_trainer.renderers.renderer import GsplatRenderer, OwnRenderer, Renderer

__all__ = ["RENDERERS", "GsplatRenderer", "OwnRenderer", "Renderer"]

RENDERERS: Registry[Renderer] = Registry("renderer", Renderer)  # type: ignore[type-abstract]
"""The renderers by name; ``RENDERERS.register("name")`` adds a class."""

RENDERERS.register("torch")(OwnRenderer)
RENDERERS.register("gsplat")(GsplatRenderer)
