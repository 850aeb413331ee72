"""The renderers of the training views, and their registry: what ``--renderer`` knows by name."""

from ca_reg.registry import Registry
from reference_trainer.renderers.gsplat import GsplatRenderer
from reference_trainer.renderers.renderer import BuiltinRenderer, Renderer

__all__ = ["RENDERERS", "BuiltinRenderer", "GsplatRenderer", "Renderer"]

RENDERERS: Registry[Renderer] = Registry(
    "renderer",
    Renderer,  # type: ignore[type-abstract]
    builtin=BuiltinRenderer,
    gsplat=GsplatRenderer,
)
"""The renderers by name; ``RENDERERS.register("name")`` adds a class."""
