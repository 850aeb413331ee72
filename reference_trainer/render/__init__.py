"""The pure-torch renderer. It takes tensors and a camera, and knows neither scenes nor the model."""

from reference_trainer.render.checks import NotFiniteError
from reference_trainer.render.renderer import Rendering, Splats, draw, masked, render, splat

__all__ = ["NotFiniteError", "Rendering", "Splats", "draw", "masked", "render", "splat"]
