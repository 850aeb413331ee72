"""The outcome of a measurement: why a score has the value it has."""

from __future__ import annotations

from enum import Enum

__all__ = ["Reason"]


class Reason(Enum):
    """The outcome of a measurement: why a score has the value it has, as a message and a remedy.

    Every member but ``OK`` and ``NO_EFFECT``, whose value is 0, comes with the value nan.

    Convention: files store ``reason.name``, such as ``"EMPTY"``; people read ``str(reason)``.

    Example:
        >>> Reason.OK.message
        'the value was measured'
        >>> print(Reason.NO_VIEWS)
        no view was measured; call update(opacity, view) before compute()
    """

    OK = ("the value was measured", "")
    EMPTY = (
        "no pixel counts: none is covered beyond the threshold",
        "lower the threshold or the drop rate; right after an opacity reset, or in a scene that is nowhere opaque, "
        "there is nothing to measure",
    )
    NOT_FINITE = (
        "NaN or infinity in an alpha, or in a color where the alpha is not 0",
        "look at the colors and opacities of the model: the training has diverged or the renderer is at fault",
    )
    OUT_OF_RANGE = (
        "the variance is above that of any colors in [0, 1]",
        "return images in [0, 1], not in 0..255; if they are, the colors of the model have diverged",
    )
    NO_EFFECT = (
        "no pixel changed in any render, although Gaussians were left out",
        "check that render_fn renders with the opacities that it is given, in place of the model's own",
    )
    NO_VIEWS = ("no view was measured", "call update(opacity, view) before compute()")

    def __init__(self, message: str, remedy: str) -> None:
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}" if self.remedy else self.message
