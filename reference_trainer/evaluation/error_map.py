"""Where a render is wrong, from one model and its training photographs: the features of `ca_reg.error_map`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry import create_meshgrid, remap
from torch import Tensor

from ca_reg.error_map import PLAIN_RATE, ErrorMap, contrast, expected_error
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.evaluation.pictures import heat_map
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render.densification import splat_weights
from reference_trainer.render.renderer import rasterize, render_moments
from reference_trainer.render.splats import Rendering
from reference_trainer.scenes.scene import View, Viewpoint

__all__ = ["ERROR_PICTURE_RANGE", "ErrorMaps", "error_map", "expected_error_picture"]

ERROR_PICTURE_RANGE = 0.25
"""Absolute error, averaged over channels, that maps to the brightest color."""

AGREEMENT = 0.05
"""Relative difference of depths up to which a photograph and a view are taken to see the same surface: wider than the
errors of depth of a good model (2 to 3 %), narrower than the step from an object to what is behind it."""

SEEN = 0.5
"""Blend weight, summed over the pixels of a photograph, above which it has shaped a Gaussian: half a pixel."""

_COVERED = 1e-4  # alpha, below which depth and color of a pixel are not defined


class ErrorMaps:
    """Expect the error of views without a photograph; what the views of a model share is computed once.

    For each training photograph that is a render with depth and its backward pass; for each view two renders, one pass
    of moments, and the warps.

    Args:
        model: which, on the views' device.
        train: its training views; without any, the maps come from the model alone.

    Example:
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> found = ErrorMaps(TrainedModel(gaussians, torch.zeros(3)))(Viewpoint("", camera))
        >>> found.error.shape, found.interval[0] < found.psnr < found.interval[1]
        (torch.Size([16, 16]), True)
    """

    @torch.no_grad()
    def __init__(self, model: TrainedModel, train: Sequence[View] = ()) -> None:
        self.model = model
        self._photographs: list[tuple[Camera, Tensor]] = []  # with depth in a fourth channel
        if not train:
            return
        opacities = model.without_camera.test_opacities
        seen = torch.zeros_like(opacities)
        for view in (view.to(opacities.device) for view in train):
            splats = model.splats(opacities, view)
            seen[splats.indices] += (splat_weights(splats) > SEEN).to(seen)
            out = rasterize(splats, depth=True)
            self._photographs.append((view.camera, torch.cat([view.image, _depth(out)[None]])))
        self._several = (seen >= 2).to(seen)  # with one training photograph, none

    @torch.no_grad()
    def __call__(self, view: Viewpoint, mask: Tensor | None = None) -> ErrorMap:
        """Return the expected error of a view; ``mask``, (H, W), as for `psnr`."""
        return expected_error(self.features(view), None if mask is None else mask > 254.5 / 255)

    @torch.no_grad()
    def features(self, view: Viewpoint) -> dict[str, Tensor]:
        """Return the features of a view, (H, W) each; see `expected_error` for what they are."""
        model, view = self.model, view.to(self.model.background.device)
        out = model.test_rendering(view, depth=True)
        plain = model.splats(model.gaussians.opacities, view)
        rate = Multiplier.dropout(model.dropout or PLAIN_RATE)
        image, splats = out.image.clamp(0, 1), out.splats
        features = {
            "empty": (1 - out.alpha).clamp_min(0),
            "contrast": contrast(image),
            "deviation": render_moments(plain, rate, background=model.background).variance.mean(0).sqrt(),
        }
        # One render brings the second moment of the colors, around their mean lest it cancels, and who saw them.
        weight = out.alpha.clamp_min(_COVERED)
        black = out.image - (1 - out.alpha) * model.background[:, None, None]
        center = black.sum((1, 2)) / out.alpha.sum().clamp_min(_COVERED)
        offsets = splats.colors - center
        several = self._several[splats.indices] if self._photographs else torch.ones_like(splats.opacities)
        known = torch.stack([offsets.square().mean(1), several, several], 1)
        second, supported, _ = rasterize(splats._replace(colors=known)).image / weight
        first = (black / weight - center[:, None, None]).square().mean(0)
        features["colors"] = (second - first).clamp_min(0).sqrt() * (out.alpha > _COVERED)
        if self._photographs:
            features["single"] = out.alpha * (1 - supported).clamp_min(0)
            features |= self._warped(view.camera, _depth(out), image)
        return features

    def _warped(self, camera: Camera, depth: Tensor, image: Tensor) -> dict[str, Tensor]:
        """Bring the training photographs into a view by the model's depth, and compare."""
        grid = create_meshgrid(*depth.shape, normalized_coordinates=False, device=depth.device, dtype=depth.dtype)[0]
        points = camera.lift(grid + 0.5, depth)
        least = torch.full_like(depth, torch.inf)
        for other, photograph in self._photographs:
            at, far = other.project(points)
            # kornia's pixel centers are integers. A border: a pixel center may lie half a pixel inside the picture.
            x, y = (at - 0.5).nan_to_num(-1.0, -1.0, -1.0)[None].unbind(-1)
            there = remap(photograph[None], x, y, padding_mode="border", align_corners=True)[0]
            same = other.inside(at, far) & ((there[3] - far).abs() < AGREEMENT * far)
            least = torch.where(same, torch.minimum(least, (there[:3] - image).abs().mean(0)), least)
        found = least.isfinite()
        return {"warp": torch.where(found, least, 0.0), "hidden": (~found).to(depth)}


def error_map(model: TrainedModel, view: Viewpoint, train: Sequence[View] = ()) -> ErrorMap:
    """Expect the error of one view; for several views of a model, keep an `ErrorMaps`."""
    return ErrorMaps(model, train)(view)


def expected_error_picture(found: ErrorMap) -> Tensor:
    """Return an expected error as a heat map (3, H, W), in the colors of the measured one."""
    return heat_map(found.error, ERROR_PICTURE_RANGE)


def _depth(out: Rendering) -> Tensor:
    """Return the mean depth of every pixel, (H, W)."""
    assert out.depth is not None
    return out.depth / out.alpha.clamp_min(_COVERED)
