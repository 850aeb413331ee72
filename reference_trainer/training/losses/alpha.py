"""A penalty on what is drawn where the photograph shows background."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from ca_reg.schedules import Schedule
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Alpha", "dark_background"]

_ROWS = 49


class Alpha(WeightedTerm):
    """``weight * mean(alpha * background)``: rendered alpha where the photograph shows background (Binocular3DGS).

    Args:
        weight: at least 0, or a schedule.
        dark: threshold of `dark_background`, which then takes the place of one minus the photograph's alpha.
            DNGaussian and Binocular3DGS use 30/255 on DTU, 15/255 for scan 110.

    Raises:
        ValueError: if one is out of range, or photographs have no alpha and ``dark`` is not given.
    """

    def __init__(self, weight: float | Schedule = 1.0, dark: float | None = None) -> None:
        super().__init__(weight)
        if dark is not None and not 0 < dark <= 1:
            raise ValueError(f"dark must be in (0, 1], got {dark}.")
        self.dark = dark
        self._backgrounds: dict[str, Tensor] = {}

    def begin(self, scene: Scene) -> None:
        """Refuse photographs without alpha if ``dark`` is not given."""
        if self.dark is None and (lacking := [view.name for view in scene.train if view.alpha is None]):
            raise ValueError(
                f"{lacking} have no alpha channel, which alpha compares with: write alpha(dark=0.118) if the "
                "background is black."
            )

    def value(self, step: Step) -> Tensor:
        """Return the mean over all pixels."""
        assert step.rendering is not None
        name = step.view.name
        if name not in self._backgrounds:
            self._backgrounds[name] = self._background(step.view)
        return (step.rendering.alpha * self._backgrounds[name]).mean()

    def _background(self, view: View) -> Tensor:
        """Return 1 where a photograph shows the background, (H, W)."""
        if self.dark is not None:
            return dark_background(view.image, self.dark)
        assert view.alpha is not None
        return 1 - view.alpha


def dark_background(image: Tensor, threshold: float) -> Tensor:
    """Return 1 where all channels of a pixel and of the 49 above it are below a threshold, shape (H, W), else 0.

    Args:
        image: colors in [0, 1], shape (3, H, W).
        threshold: above 0.

    Example:
        >>> import torch
        >>> image = torch.zeros(3, 60, 1)
        >>> image[1, 5] = 0.5
        >>> dark_background(image, 0.1)[:, 0].nonzero().flatten().tolist()
        [0, 1, 2, 3, 4, 55, 56, 57, 58, 59]
    """
    bright = (image.amax(0) >= threshold).to(image.dtype)
    return 1 - max_pool2d(pad(bright[None], (0, 0, _ROWS, 0)), (_ROWS + 1, 1), stride=1)[0]
