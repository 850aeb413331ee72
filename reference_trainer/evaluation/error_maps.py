"""Where a render is wrong, from one model and its training photographs: the features of `ca_reg.error_maps`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry import remap
from torch import Tensor

from ca_reg.error_maps import PLAIN_RATE, TRANSFER, ErrorMap, contrast, expected_error
from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.render.renderer import rasterize, render_moments
from reference_trainer.render.splats import Rendering
from reference_trainer.scenes.scene import View, Viewpoint

__all__ = ["ErrorMaps"]

AGREEMENT = 0.05
"""Relative difference of depths up to which a photograph and a view are taken to see the same surface: wider than the
errors of depth of a good model (2 to 3 %), narrower than the step from an object to what is behind it."""

NEAREST = 8
"""Photographs, of the nearest cameras, that are warped into a view; and training views that the unit is taken from."""

_COVERED = 0.5  # alpha, below which a pixel has no surface to look at from elsewhere
_TINY = 1e-4  # alpha, below which a pixel has no color of its own


class ErrorMaps:
    """Expect the error of views without a photograph; what the views of a model share is computed once.

    Weights fitted on other scenes rank the pixels; this scene's photographs set the scale. Each training photograph is
    predicted from the others, which are warped into it by the model's depth. The unit of the maps follows from the
    ratio of the measured difference to the one that the sum of features expects there.

    A map takes two renders, a pass of moments, and the warps. Before the first, every training view takes a render, and
    up to `NEAREST` of them a map.

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
        self._train, self.unit = [view.to(model.background.device) for view in train], 1.0
        if not train:
            return
        for view in self._train:
            depth = _depth(model.test_rendering(view, depth=True))
            self._photographs.append((view.camera, torch.cat([view.image, depth[None]])))
        measured = expected = 0.0
        for number in range(0, len(train), -(-len(train) // NEAREST)):
            difference, features = self.left_out(number)
            shown = features["hidden"] == 0
            measured += difference.sum().item()
            expected += expected_error(features).error[shown].sum().item()
        if measured > 0 and expected > 0:
            self.unit = TRANSFER * measured / expected

    @torch.no_grad()
    def __call__(self, view: Viewpoint, mask: Tensor | None = None) -> ErrorMap:
        """Return the expected error of a view; ``mask``, (H, W), as for `psnr`."""
        return expected_error(self.features(view), None if mask is None else mask > 254.5 / 255, unit=self.unit)

    @torch.no_grad()
    def left_out(self, number: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Predict a training photograph from the others.

        Returns the least absolute difference, (H, W), 0 where none can be brought; and the features of the view as if
        its own photograph had not been taken.
        """
        view, (_, photograph) = self._train[number], self._photographs[number]
        found = self._warped(view.camera, photograph[3], photograph[:3], without=number)
        return found["warp"], self.features(view, without=number)

    @torch.no_grad()
    def features(self, view: Viewpoint, *, without: int | None = None) -> dict[str, Tensor]:
        """Return the features of a view, (H, W) each; see `expected_error` for what they are.

        ``without`` is the position of a photograph that is not brought into the view.
        """
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
        # `color_variance_map` with one render less: the first moment is the picture's.
        weight = out.alpha.clamp_min(_TINY)
        black = out.image - (1 - out.alpha) * model.background[:, None, None]
        center = black.sum((1, 2)) / out.alpha.sum().clamp_min(_TINY)  # moments around it cancel less
        second = rasterize(splats._replace(colors=(splats.colors - center).square())).image / weight
        variance = (second - (black / weight - center[:, None, None]).square()).mean(0)
        features["colors"] = variance.clamp_min(0).sqrt() * (out.alpha > _TINY)
        if self._photographs:
            features |= self._warped(view.camera, _depth(out), image, without)
        return features

    @torch.no_grad()
    def support(self, view: Viewpoint) -> Tensor:
        """Return how many of the `NEAREST` photographs show the surface of a pixel, (H, W); nan without a surface."""
        view = view.to(self.model.background.device)
        out = self.model.test_rendering(view, depth=True)
        depth = _depth(out)
        return self._warped(view.camera, depth, out.image)["support"].where(depth.isfinite(), torch.nan)

    def _warped(self, camera: Camera, depth: Tensor, image: Tensor, without: int | None = None) -> dict[str, Tensor]:
        """Bring the nearest training photographs into a view by the model's depth, and compare."""
        others = [each for i, each in enumerate(self._photographs) if i != without]
        others.sort(key=lambda each: float((each[0].position - camera.position).norm()))
        points = camera.lift(camera.pixel_centers(depth), depth)
        least, support = torch.full_like(depth, torch.inf), torch.zeros_like(depth)
        for other, photograph in others[:NEAREST]:
            at, far = other.project(points)
            # kornia's pixel centers are integers. A border: a pixel center may lie half a pixel inside the picture.
            x, y = (at - 0.5).nan_to_num(-1.0, -1.0, -1.0)[None].unbind(-1)
            there = remap(photograph[None], x, y, padding_mode="border", align_corners=True)[0]
            same = other.inside(at, far) & ((there[3] - far).abs() < AGREEMENT * far)
            least = torch.where(same, torch.minimum(least, (there[:3] - image).abs().mean(0)), least)
            support += same
        found = support > 0
        return {"warp": torch.where(found, least, 0.0), "hidden": (~found).to(depth), "support": support}


def _depth(out: Rendering) -> Tensor:
    """Return the mean depth of every pixel, (H, W); nan, which agrees with nothing, where there is no surface."""
    assert out.depth is not None
    return torch.where(out.alpha > _COVERED, out.depth / out.alpha, torch.nan)
