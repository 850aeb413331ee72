"""What the viewer shows: a model in the chosen display mode, independent of any browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise, Reason
from reference_trainer.camera import Camera
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE, ca_picture
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.shares import PER_WEIGHT_SCALE, Heat, colored_by
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.scenes.scene import Viewpoint

__all__ = ["DisplayOptions", "Mode", "ViewerModel"]

Mode = Literal["render", "co-adaptation", "depth", "heat"]


@dataclass(frozen=True)
class DisplayOptions:
    """How a model is shown.

    Args:
        mode: the test-time render, the exact CA map, depth, or the Gaussians in the colors of their `Heat`.
        drop_rate: of the CA map and of the mask, in [0, 1).
        noise: standard deviation of the opacity noise, at least 0: the CA map is that of dropout and noise together,
            all other pictures show one draw of it.
        mask: whether pictures other than the CA map drop the Gaussians of one random mask.
        hidden: fraction of the Gaussians to leave out, those of highest heat first, in [0, 1).
    """

    mode: Mode = "render"
    drop_rate: float = 0.5
    noise: float = 0.0
    mask: bool = False
    hidden: float = 0.0


class ViewerModel:
    """A model to show; what successive pictures share is computed once.

    Args:
        model: what to draw.
        views: that its heat is measured at, on the model's device.

    Example:
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> shown = ViewerModel(TrainedModel(gaussians, torch.zeros(3)), [])
        >>> image, note = shown.render(DisplayOptions("co-adaptation"), camera)
        >>> image.shape
        torch.Size([3, 16, 16])
    """

    def __init__(self, model: TrainedModel, views: Sequence[Viewpoint]) -> None:
        self.model = model
        self._views = views
        self._chosen_last: tuple[DisplayOptions | None, TrainedModel] = None, model

    @cached_property
    def heat(self) -> Heat:
        """The heat at drop rate 1/2; ValueError if no view has a score, or all scores are 0."""
        return Heat.of(self.model, self._views)

    @torch.no_grad()
    def render(self, options: DisplayOptions, camera: Camera) -> tuple[Tensor, str]:
        """Return a picture (3, H, W) in [0, 1] and a note on it.

        Raises:
            ValueError: if heat is needed (for its colors or to hide Gaussians) and cannot be measured, see `heat`.
        """
        if options != self._chosen_last[0]:
            self._chosen_last = options, self._chosen(options)
        model, view = self._chosen_last[1], Viewpoint("", camera.to(self.model.gaussians.means.device))
        if options.mode == "co-adaptation":
            score = CAScore.exact(model.moments, regularizer=_draws(options))
            result = score(model.gaussians.opacities, view)
            rate, noise = options.drop_rate, options.noise
            of = f" at drop rate {rate:g}" * (rate != 0.5) + f" with noise {noise:g}" * (noise > 0)
            said = f"exact CA{of} {result.value * 1e3:.2f}e-3" if result.reason is Reason.OK else str(result.reason)
            return ca_picture(result), f"{said}; variance 0 (black) to {CA_PICTURE_RANGE:g}, gray: not covered"
        out = model.test_rendering(view, depth=options.mode == "depth")
        if out.depth is None:
            return out.image.clamp(0, 1), self._note_on_heat(options)
        nearness = torch.where(out.alpha > 0.5, out.alpha / out.depth, torch.nan)
        if not (seen := nearness[nearness.isfinite()]).numel():
            return torch.full_like(out.image, 0.5), "nothing covers half of a pixel"
        low, high = seen[:: 1 + len(seen) // 10_000].quantile(seen.new_tensor([0.02, 0.98])).tolist()
        colors = heat_colors(nearness.flatten(), low, max(high, low * 1.001))
        return colors.T.view_as(out.image), f"depth {1 / high:.3g} (bright) to {1 / low:.3g}"

    def _note_on_heat(self, options: DisplayOptions) -> str:
        """Return a note on what the colors mean and how much co-adaptation is hidden."""
        said = []
        if options.mode == "heat":
            said.append(
                "share of the exact CA per blend weight, {:g} (dark) to {:g} times the mean".format(*PER_WEIGHT_SCALE)
            )
        if options.hidden:
            shares = self.heat.shares
            said.append(
                f"{shares[self.heat.ranks >= 1 - options.hidden].sum() / shares.sum():.0%} of the exact CA are hidden"
            )
        return "; ".join(said)

    def _chosen(self, options: DisplayOptions) -> TrainedModel:
        """Return the model with the Gaussians, colors and opacities of some options."""
        gaussians, regularizer = self.model.gaussians, self.model.regularizer
        if options.mode != "co-adaptation" and (options.mask or options.noise):  # in place of the test-time opacities
            drawn = _draws(options).regularize(
                gaussians.params(), torch.Generator(gaussians.means.device).manual_seed(0)
            )
            gaussians, regularizer = replace(gaussians, opacity_logits=drawn.opacities.logit()), ""
        if options.mode == "heat":
            low, high = (end * self.heat.mean for end in PER_WEIGHT_SCALE)
            gaussians = colored_by(gaussians, self.heat.values, low, high)
        if options.hidden:
            gaussians = gaussians[self.heat.ranks < 1 - options.hidden]
        return replace(self.model, gaussians=gaussians, regularizer=regularizer)


def _draws(options: DisplayOptions) -> Chain:
    """Return the regularizers whose draw or whose exact variance is shown."""
    dropped = options.mask or options.mode == "co-adaptation"
    return Chain(GaussianDropout(options.drop_rate if dropped else 0.0), OpacityNoise(options.noise))
