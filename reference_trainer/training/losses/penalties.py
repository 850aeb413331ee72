"""Penalties on the Gaussians themselves, and on what is rendered where nothing is."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from ca_reg._check import check_finite
from ca_reg.schedules import Schedule
from reference_trainer.rotations import rotations
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Alpha", "Flat", "Opacity", "RayExtent", "Scale", "dark_background", "ray_extents"]

_ROWS = 49


class Alpha(WeightedTerm):
    """``weight * mean(alpha * background)``: rendered alpha where the photograph shows background (Binocular3DGS).

    Args:
        weight: at least 0, or a schedule.
        dark: threshold of `dark_background`, which then takes the place of one minus the photograph's alpha.
            DNGaussian and Binocular3DGS use 30/255 on DTU, 15/255 for scan 110.
        optional: whether a photograph without an alpha channel is all foreground, instead of being refused.
    """

    def __init__(self, weight: float | Schedule = 1.0, dark: float | None = None, optional: bool = False) -> None:
        super().__init__(weight)
        if dark is not None and not 0 < dark <= 1:
            raise ValueError(f"dark must be in (0, 1], got {dark}.")
        self.dark, self.optional = dark, optional
        self._left_out = False
        self._backgrounds: dict[str, Tensor] = {}

    def begin(self, scene: Scene) -> None:
        """Refuse photographs without alpha if neither ``dark`` is given nor the term optional."""
        lacking = [] if self.dark is not None else [view.name for view in scene.train if view.alpha is None]
        self._left_out = len(lacking) == len(scene.train)
        if lacking and not self.optional:
            raise ValueError(
                f"{lacking} have no alpha channel, which alpha compares with: write alpha(dark=0.118) if the "
                "background is black."
            )

    def acts(self, number: int) -> bool:
        """Return whether any photograph has what it compares with, and the weight at this step is not 0."""
        return not self._left_out and super().acts(number)

    def value(self, step: Step) -> Tensor:
        """Return the mean over all pixels."""
        assert step.rendering is not None
        # Computed once per photograph: it does not change, and pooling 49 rows is not free.
        name = step.view.name
        if name not in self._backgrounds:
            photograph = step.view.over(step.photographed_over, step.background)  # that is another at each step
            self._backgrounds[name] = self._background(photograph)
        return (step.rendering.alpha * self._backgrounds[name]).mean()

    def _background(self, view: View) -> Tensor:
        """Return 1 where a photograph shows the background, (H, W)."""
        if self.dark is not None:
            return dark_background(view.image, self.dark)
        return torch.zeros_like(view.image[0]) if view.alpha is None else 1 - view.alpha


def dark_background(image: Tensor, threshold: float) -> Tensor:
    """Return 1 where all channels of a pixel and of the 49 above it are below a threshold, shape (H, W), else 0.

    Example:
        >>> import torch
        >>> image = torch.zeros(3, 60, 1)
        >>> image[1, 5] = 0.5
        >>> dark_background(image, 0.1)[:, 0].nonzero().flatten().tolist()
        [0, 1, 2, 3, 4, 55, 56, 57, 58, 59]
    """
    bright = (image.amax(0) >= threshold).to(image.dtype)
    return 1 - max_pool2d(pad(bright[None], (0, 0, _ROWS, 0)), (_ROWS + 1, 1), stride=1)[0]


class Flat(WeightedTerm):
    """``weight * mean(max(longest / shortest axis - limit, 0))`` over the Gaussians: against needles and flakes.

    Args:
        weight: at least 0, or a schedule. DNGaussian uses 0.002 on LLFF and 0.005 on DTU.
        limit: ratio up to which nothing is penalized, at least 1; 1 gives DNGaussian's term but for a constant.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.002, limit: float = 1.0) -> None:
        super().__init__(weight)
        check_finite(limit, "limit", minimum=1, hint=": 1 is the ratio of a sphere")
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the mean excess."""
        scales = step.params.scales
        assert scales is not None
        return (scales.amax(1) / scales.amin(1) - self.limit).clamp_min(0).mean()


class Scale(WeightedTerm):
    """``weight * mean(max(longest axis - limit, 0)^2)`` over the Gaussians.

    Args:
        weight: at least 0, or a schedule. DNGaussian uses 0.001 on LLFF and 0.005 on DTU, per squared world unit.
        limit: standard deviation up to which nothing is penalized, at least 0, world units; DNGaussian has none.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.001, limit: float = 0.0) -> None:
        super().__init__(weight)
        check_finite(limit, "limit", minimum=0)
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the mean squared excess."""
        scales = step.params.scales
        assert scales is not None
        return (scales.amax(1) - self.limit).clamp_min(0).square().mean()


class RayExtent(WeightedTerm):
    """``weight * sum(max(r - limit, 0))`` over the Gaussians in front of the step's camera, r their `ray_extents`.

    No photograph can tell how far something extends along its rays. What does so by a good part of its distance is a
    few pixels there, and a veil before a camera beside. Shapes learn from this, positions do not.

    Args:
        weight: at least 0, or a schedule; a sum, so that the number of Gaussians does not matter.
        limit: extent up to which nothing is penalized, above 0.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.01, limit: float = 0.1) -> None:
        super().__init__(weight)
        if not 0 < limit < float("inf"):
            raise ValueError(f"limit must be positive and finite, got {limit}.")
        self.limit = limit

    def value(self, step: Step) -> Tensor:
        """Return the sum of the excesses."""
        means, scales, quaternions = step.params.means, step.params.scales, step.params.quaternions
        assert means is not None
        assert scales is not None
        assert quaternions is not None
        camera = step.view.camera
        offsets = means.detach() - camera.position
        asked = offsets @ camera.forward > 0
        # Most are too small to reach the limit; on a card, choosing the others would be a wait.
        long = slice(None) if means.is_cuda else scales.detach().amax(1) > self.limit * offsets.norm(dim=1)
        extents = ray_extents(offsets[long], scales[long], quaternions[long])
        return (asked[long] * (extents - self.limit).clamp_min(0)).sum()


def ray_extents(offsets: Tensor, scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return the standard deviation of every Gaussian along the ray through its center, by its distance: (N,).

    The centers are ``offsets`` (N, 3) from the camera; scales are (N, 3), quaternions (N, 4), wxyz. 0 at the camera.

    Example:
        >>> import torch
        >>> offsets, scales = torch.tensor([[0.0, 0.0, 4.0]]), torch.tensor([[0.1, 0.2, 1.0]])
        >>> ray_extents(offsets, scales, torch.tensor([[1.0, 0.0, 0.0, 0.0]])).item()
        0.25
    """
    distances = offsets.norm(dim=1).clamp_min(1e-30)
    along = (rotations(quaternions) * (offsets.T / distances)[:, None]).sum(0)
    extents: Tensor = (along * scales.T).norm(dim=0) / distances
    return extents


class Opacity(WeightedTerm):
    """``weight`` times the mean opacity (3DGS-MCMC), or with ``split`` DNGaussian's reward of opaque Gaussians.

    Args:
        weight: at least 0, or a schedule. 3DGS-MCMC uses 0.01 for the mean, DNGaussian 0.001 for its reward.
        split: in (0, 1): the value is ``1 - mean(o^2 | o > split) + mean((1 - o)^2 | o < split)``, as in DNGaussian's
            code with 0.2; an empty part counts 0.
    """

    analytic = True

    def __init__(self, weight: float | Schedule = 0.01, split: float | None = None) -> None:
        super().__init__(weight)
        if split is not None and not 0 < split < 1:
            raise ValueError(f"split must be in (0, 1), got {split}.")
        self.split = split

    def value(self, step: Step) -> Tensor:
        """Return the mean, or one minus the reward."""
        opacities = step.params.opacities
        if self.split is None:
            return opacities.mean()
        # Sums over masks instead of indexing, whose shapes would depend on the values: no wait on a GPU.
        above, below = opacities > self.split, opacities < self.split
        reward = (opacities.square() * above).sum() / above.sum().clamp_min(1)
        return 1 - reward + ((1 - opacities).square() * below).sum() / below.sum().clamp_min(1)
