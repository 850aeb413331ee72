"""The renderer: tensors and a camera in, a picture out. It knows neither scenes nor the model.

Three engines render: loops compiled by numba for float32 on a CPU, Triton kernels for float32 on a
card, and PyTorch operations for everything else, which the others are tested against. `use_engine`
chooses.
"""

from reference_trainer.render.checks import NotFiniteError
from reference_trainer.render.engine import chosen_engine, describe_engine, use_engine
from reference_trainer.render.renderer import rasterize, render, render_masks, render_moments, splat, variance_shares
from reference_trainer.render.splats import MomentImages, Rendering, Splats, ViewSplats

__all__ = [
    "MomentImages", "NotFiniteError", "Rendering", "Splats", "ViewSplats", "chosen_engine", "describe_engine",
    "rasterize", "render", "render_masks", "render_moments", "splat", "use_engine", "variance_shares",
]  # fmt: skip
