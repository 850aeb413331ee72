"""What the viewer shows: a model in the chosen display mode, independent of any browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from kornia.geometry import remap
from torch import Tensor

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise, Reason
from reference_trainer.camera import Camera
from reference_trainer.evaluation.error_maps import NEAREST, ErrorMaps
from reference_trainer.evaluation.evaluate import (
    CA_PICTURE_RANGE,
    ERROR_PICTURE_RANGE,
    ca_picture,
    expected_error_picture,
)
from reference_trainer.evaluation.pictures import heat_colors, heat_map
from reference_trainer.evaluation.shares import PER_WEIGHT_SCALE, Heat, colored_by
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.scenes.scene import View, Viewpoint

__all__ = ["Display", "DisplayOptions", "Mode", "ViewerModel", "with_photograph"]

Mode = Literal["render", "co-adaptation", "expected error", "support", "depth", "heat"]


@dataclass(frozen=True)
class DisplayOptions:
    """How a model is shown.

    The modes are the test-time render, the exact CA map, where the render is expected to be wrong (`ErrorMaps`), how
    many training photographs show what is there, depth, and the Gaussians in the colors of their `Heat`. The CA map is
    that of dropout and noise together; all other pictures show one draw of the noise.
    """

    mode: Mode = "render"
    drop_rate: float = 0.5  # of the CA map and of the mask, in [0, 1)
    noise: float = 0.0  # standard deviation of the opacity noise, at least 0
    mask: bool = False  # whether pictures other than the CA map drop the Gaussians of one random mask
    hidden: float = 0.0  # fraction of the Gaussians to leave out, those of highest heat first, in [0, 1)


class Display(NamedTuple):
    """An image (3, H, W) in [0, 1], a note on it, and what its color bar means: low end, high end, quantity."""

    image: Tensor
    note: str
    scale: tuple[str, str, str] | None = None


class ViewerModel:
    """A model to show; what successive pictures share is computed once.

    Its heat is measured at ``views``, which are on its device. The unit of the heat's colors is the mean heat of
    ``beside``, so that two models can be compared; without it, the model's own. ``train`` are the photographs that it
    was trained on, for the expected error and the support.

    Example:
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> shown = ViewerModel(TrainedModel(gaussians, torch.zeros(3)), [])
        >>> display = shown.render(DisplayOptions("co-adaptation"), camera)
        >>> display.image.shape, display.scale[:2]
        (torch.Size([3, 16, 16]), ('0', '0.02'))
    """

    def __init__(
        self,
        model: TrainedModel,
        views: Sequence[Viewpoint],
        beside: ViewerModel | None = None,
        train: Sequence[View] = (),
    ) -> None:
        self.model = model
        self.views = views
        self.train = train
        self._beside = beside or self
        self._chosen_last: tuple[DisplayOptions | None, TrainedModel] = None, model

    @cached_property
    def heat(self) -> Heat:
        """The heat at drop rate 1/2; ValueError if no view has a score, or all scores are 0."""
        return Heat.of(self.model, self.views)

    @cached_property
    def error_maps(self) -> ErrorMaps:
        """What is expected to be wrong, by the model and its training photographs."""
        return ErrorMaps(self.model, self.train)

    @torch.no_grad()
    def render(self, options: DisplayOptions, camera: Camera) -> Display:
        """Render the model.

        Raises ValueError if heat is needed (for its colors or to hide Gaussians) and cannot be measured, see `heat`; or
        support without photographs.
        """
        view = Viewpoint("", camera.to(self.model.gaussians.means.device))
        match options.mode:
            case "expected error":
                return self._expected_error(view)
            case "support":
                return self._support(view)
            case "co-adaptation":
                return _co_adaptation(options, self.chosen(options), view)
            case "depth":
                return _depth(self.chosen(options), view)
        return self._render(options, view)

    def _render(self, options: DisplayOptions, view: Viewpoint) -> Display:
        """Render the colors of a model, which those of its heat may have replaced."""
        image, note, scale = self.chosen(options).test_rendering(view).image.clamp(0, 1), "", None
        if options.mode == "heat":
            low, high = PER_WEIGHT_SCALE
            scale = f"{low:g}", f"{high:g}", "share of the exact CA per blend weight, over the mean"
        if options.hidden:
            shares = self.heat.shares
            hidden = shares[self.heat.ranks >= 1 - options.hidden].sum() / shares.sum()
            note = f"{hidden:.0%} of the exact CA are hidden"
        return Display(image, note, scale)

    def _expected_error(self, view: Viewpoint) -> Display:
        """Render the expected error of the whole model: hidden and masked Gaussians count."""
        found = self.error_maps(view)
        low, high = found.interval
        scale = "0", f"{ERROR_PICTURE_RANGE:g}", "expected absolute error of the color"
        return Display(expected_error_picture(found), f"expected {found.psnr:.1f} dB, {low:.1f} to {high:.1f}", scale)

    def _support(self, view: Viewpoint) -> Display:
        """Render how many training photographs show the surface of the whole model, as `_expected_error` does."""
        if not self.train:
            raise ValueError("the support is told by the training photographs, of which there are none: give --scene.")
        most, support = min(len(self.train), NEAREST), self.error_maps.support(view)
        none, one = ((support == count).double().mean().item() for count in (0, 1))
        scale = "0", f"{most}", "photographs that show it, by the model's depth; gray: nothing covers half of the pixel"
        return Display(heat_map(support, most), f"shown by no photograph {none:.0%}, by one {one:.0%}", scale)

    @torch.no_grad()
    def chosen(self, options: DisplayOptions) -> TrainedModel:
        """Return the model with the Gaussians, colors and opacities of some options; the last one is kept."""
        if options == self._chosen_last[0]:
            return self._chosen_last[1]
        gaussians, regularizer = self.model.gaussians, self.model.regularizer
        if options.mode != "co-adaptation" and (options.mask or options.noise):  # in place of the test-time opacities
            drawn = _draws(options).regularize(
                gaussians.params(), torch.Generator(gaussians.means.device).manual_seed(0)
            )
            gaussians, regularizer = replace(gaussians, opacity_logits=drawn.opacities.logit()), ""
        if options.mode == "heat":
            low, high = (end * self._beside.heat.mean for end in PER_WEIGHT_SCALE)
            gaussians = colored_by(gaussians, self.heat.values, low, high)
        if options.hidden:
            gaussians = gaussians[self.heat.ranks < 1 - options.hidden]
        self._chosen_last = options, replace(self.model, gaussians=gaussians, regularizer=regularizer)
        return self._chosen_last[1]


def _co_adaptation(options: DisplayOptions, model: TrainedModel, view: Viewpoint) -> Display:
    """Render the exact variance of every pixel."""
    result = CAScore.exact(model.moments, regularizer=_draws(options))(model.gaussians.opacities, view)
    rate, noise = options.drop_rate, options.noise
    of = f" at drop rate {rate:g}" * (rate != 0.5) + f" with noise {noise:g}" * (noise > 0)
    note = f"exact CA{of} {result.value * 1e3:.2f}e-3" if result.reason is Reason.OK else str(result.reason)
    scale = "variance of the color"
    if not bool(result.visible.all()):
        note += f", {1 - result.visible.double().mean().item():.0%} of the picture not covered"
        scale += "; gray, not covered: when Gaussians are left out, more than a fifth is background on average"
    return Display(ca_picture(result), note, ("0", f"{CA_PICTURE_RANGE:g}", scale))


def _depth(model: TrainedModel, view: Viewpoint) -> Display:
    """Render the nearness of what covers half of a pixel at least."""
    out = model.test_rendering(view, depth=True)
    assert out.depth is not None
    nearness = torch.where(out.alpha > 0.5, out.alpha / out.depth, torch.nan)
    if not (seen := nearness[nearness.isfinite()]).numel():
        return Display(torch.full_like(out.image, 0.5), "nothing covers half of a pixel")
    low, high = seen[:: 1 + len(seen) // 10_000].quantile(seen.new_tensor([0.02, 0.98])).tolist()
    colors = heat_colors(nearness.flatten(), low, max(high, low * 1.001))
    scale = f"{1 / low:.3g}", f"{1 / high:.3g}", "depth; gray: nothing covers half of the pixel"
    return Display(colors.T.view_as(out.image), "", scale)


def _draws(options: DisplayOptions) -> Chain:
    """Return the regularizers whose draw or whose exact variance is shown."""
    dropped = options.mask or options.mode == "co-adaptation"
    return Chain(GaussianDropout(options.drop_rate if dropped else 0.0), OpacityNoise(options.noise))


def with_photograph(image: Tensor, camera: Camera, view: View, share: float) -> Tensor:
    """Return an image (3, H, W) mixed with a ``share``, in [0, 1], of a photograph taken from the same place.

    ``camera``, which sees the image, may be turned against that of the photograph, or have another field of view.
    """
    ones = torch.ones(camera.height, camera.width)
    points = camera.to("cpu").lift(camera.pixel_centers(ones), ones)
    pixels, depth = view.camera.to("cpu").project(points)
    x, y = (pixels - 0.5)[None].unbind(-1)  # kornia's pixel centers are integers
    seen = remap(view.image.cpu()[None], x, y, padding_mode="border", align_corners=True)[0]
    return torch.lerp(image.cpu(), seen, share * view.camera.inside(pixels, depth))
