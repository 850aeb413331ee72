"""The pure functions behind the modules: they hold no state, change no argument and draw only when asked to."""

from ca_reg.functional.dropout import apply_dropout, draw_keep_mask, gaussian_dropout
from ca_reg.functional.noise import apply_opacity_noise, draw_opacity_noise, opacity_noise
from ca_reg.functional.scaling import scale_opacity
from ca_reg.functional.variance import ColorVariance, color_variance

__all__ = [
    "ColorVariance",
    "apply_dropout",
    "apply_opacity_noise",
    "color_variance",
    "draw_keep_mask",
    "draw_opacity_noise",
    "gaussian_dropout",
    "opacity_noise",
    "scale_opacity",
]
