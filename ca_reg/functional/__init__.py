"""The pure functions behind the modules: they hold no state, change no argument and draw only when asked to.

All check their arguments: a wrong type, also an integer tensor, raises a TypeError; a shape or value other than
documented, such as a negative opacity, a ValueError.
"""

from ca_reg._random import draw_numbers
from ca_reg.functional.expected_losses import expected_absolute_error, expected_squared_error
from ca_reg.functional.moments import (
    PixelMoments,
    alpha_moments,
    contributions,
    first_order_variance,
    neutral_background,
    pixel_moments,
)
from ca_reg.functional.multipliers import Multiplier
from ca_reg.functional.opacities import (
    apply_dropout,
    apply_opacity_noise,
    decayed_logits,
    draw_keep_mask,
    draw_opacity_noise,
    expected_opacity,
    gaussian_dropout,
    opacity_noise,
    scale_opacity,
)
from ca_reg.functional.variance import ColorVariance, color_variance

__all__ = [
    "ColorVariance", "Multiplier", "PixelMoments", "alpha_moments", "apply_dropout", "apply_opacity_noise",
    "color_variance", "contributions", "decayed_logits", "draw_keep_mask", "draw_numbers", "draw_opacity_noise",
    "expected_absolute_error", "expected_opacity", "expected_squared_error", "first_order_variance",
    "gaussian_dropout", "neutral_background", "opacity_noise", "pixel_moments", "scale_opacity",
]  # fmt: skip
