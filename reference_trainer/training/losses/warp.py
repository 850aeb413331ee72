"""Binocular3DGS's consistency of the rendered depth with a render from a camera shifted sideways."""

from __future__ import annotations

from dataclasses import replace

import torch
from kornia.filters import spatial_gradient
from kornia.geometry import create_meshgrid, remap
from torch import Tensor

from ca_reg._check import check_finite
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Warp", "edge_aware_smoothness", "warp_horizontally"]


class Warp(WeightedTerm):
    """``weight * (mean|M (warped - photograph)| + smooth * smoothness(M disparity))`` of Binocular3DGS (NeurIPS 2024).

    A camera shifted along its x axis by t, drawn from -shift to shift, is rendered with the plain model and warped back
    by the disparity ``-fx t / (depth + 1e-5)`` of the step's render; M is 1 where the warp stays inside.

    Args:
        weight: at least 0, or a schedule. The source begins at step 20,000 of 30,000: ``between(1.0, 20_000)``.
        shift: largest shift, above 0, world units: for a world in other units than the source's, scale it.
        smooth: weight of the smoothness, at least 0.

    Raises:
        ValueError: if one is out of range, or ``smooth`` not finite.
    """

    needs = frozenset({"depth"})

    def __init__(self, weight: float | Schedule = 1.0, shift: float = 0.4, smooth: float = 0.05) -> None:
        super().__init__(weight)
        if not shift > 0:
            raise ValueError(f"shift must be positive, got {shift}.")
        check_finite(smooth, "smooth", minimum=0)
        self.shift, self.smooth = shift, smooth

    def value(self, step: Step) -> Tensor:
        """Render the shifted camera and compare."""
        camera, photograph, generator = step.view.camera, step.view.image, step.generator("warp")
        shift = self.shift * (2 * torch.rand((), generator=generator, device=generator.device) - 1).item()
        pose = camera.world_to_camera.clone()
        pose[0, 3] -= shift
        shifted = step.render(replace(camera, world_to_camera=pose)).image
        disparity = -camera.fx * shift / (step.depth + 1e-5)
        warped, inside = warp_horizontally(shifted, disparity)
        error = (inside * (warped - photograph)).abs().mean()
        return error + self.smooth * edge_aware_smoothness(inside * disparity, photograph)


def warp_horizontally(image: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor]:
    """Sample a picture a disparity to the right of every pixel; return the result and where that stays inside.

    Args:
        image: shape (C, H, W).
        disparity: pixels, shape (H, W).

    Returns:
        The picture (C, H, W), bilinearly interpolated, and a mask (H, W) of zeros and ones.

    Example:
        >>> image, disparity = torch.arange(4.0).expand(1, 2, 4), torch.full((2, 4), 0.5)
        >>> warped, inside = warp_horizontally(image, disparity)
        >>> (inside * warped)[0, 0].round(decimals=4).tolist(), inside[0].tolist()
        ([0.5, 1.5, 2.5, 0.0], [1.0, 1.0, 1.0, 0.0])
    """
    height, width = disparity.shape
    x, y = create_meshgrid(height, width, normalized_coordinates=False, device=image.device, dtype=image.dtype)[
        0
    ].unbind(-1)
    x = x + disparity
    inside = (x >= 0) & (x < width - 1)
    return remap(image[None], x[None], y[None], align_corners=True)[0], inside.to(image.dtype)


def edge_aware_smoothness(disparity: Tensor, image: Tensor) -> Tensor:
    """Return ``mean |exp(-0.33 |dI|) dD|`` along x plus along y: central differences, I the sum of the channels.

    Args:
        disparity: shape (H, W).
        image: shape (C, H, W), same size; the border pixels are left out.

    Example:
        >>> edge_aware_smoothness(torch.arange(5.0).expand(4, 5), torch.zeros(3, 4, 5)).item()
        1.0
    """
    images = torch.stack([image.sum(0), disparity])
    edges, steps = spatial_gradient(images[None], mode="diff")[0, :, :, 1:-1, 1:-1]
    smoothness: Tensor = (torch.exp(-0.33 * edges.abs()) * steps).abs().mean((-2, -1)).sum()
    return smoothness
