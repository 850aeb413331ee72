"""What the viewer draws: a model in the chosen display mode, independent of any browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise
from reference_trainer.camera import Camera
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE, ca_picture
from reference_trainer.evaluation.pictures import heat_colors
from reference_trainer.evaluation.shares import PER_WEIGHT_SCALE, Heat, colored_by
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.scenes.scene import Viewpoint

__all__ = ["Look", "Mode", "Subject"]

Mode = Literal["render", "co-adaptation", "depth", "heat"]


@dataclass(frozen=True)
class Look:
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


class Subject:
    """A model to show; what successive pictures share is computed once.

    Args:
        model: what to draw.
        views: that its heat is measured at, on the model's device.

    Example:
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> gaussians = Gaussians.from_points(torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.1), sh_degree=1)
        >>> camera = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
        >>> image, note = Subject(TrainedModel(gaussians, torch.zeros(3)), []).draw(Look("co-adaptation"), camera)
        >>> image.shape
        torch.Size([3, 16, 16])
    """

    def __init__(self, model: TrainedModel, views: Sequence[Viewpoint]) -> None:
        self.model = model
        self._views = views
        self._drawn: tuple[Look | None, TrainedModel] = None, model

    @cached_property
    def heat(self) -> Heat:
        """The heat at drop rate 1/2; ValueError if no view has a score, or all scores are 0."""
        return Heat.of(self.model, self._views)

    @torch.no_grad()
    def draw(self, look: Look, camera: Camera) -> tuple[Tensor, str]:
        """Return a picture (3, H, W) in [0, 1] and a note on it.

        Raises:
            ValueError: if heat is needed (for its colors or to hide Gaussians) and cannot be measured, see `heat`.
        """
        if look != self._drawn[0]:
            self._drawn = look, self._chosen(look)
        model, view = self._drawn[1], Viewpoint("", camera.to(self.model.gaussians.means.device))
        if look.mode == "co-adaptation":
            score = CAScore.exact(model.moments, regularizer=_draws(look))
            result = score(model.gaussians.opacities, view)
            said = f"exact CA {result.value * 1e3:.2f}e-3" if result.value == result.value else str(result.reason)
            return ca_picture(result), f"{said}; variance 0 (black) to {CA_PICTURE_RANGE:g}, gray: not covered"
        out = model.test_rendering(view, depth=look.mode == "depth")
        if out.depth is None:
            return out.image.clamp(0, 1), self._said_of_heat(look)
        nearness = torch.where(out.alpha > 0.5, out.alpha / out.depth, torch.nan)
        if not (seen := nearness[nearness.isfinite()]).numel():
            return torch.full_like(out.image, 0.5), "nothing covers half of a pixel"
        low, high = seen[:: 1 + len(seen) // 10_000].quantile(seen.new_tensor([0.02, 0.98])).tolist()
        colors = heat_colors(nearness.flatten(), low, max(high, low * 1.001))
        return colors.T.view_as(out.image), f"depth {1 / high:.3g} (bright) to {1 / low:.3g}"

    def _said_of_heat(self, look: Look) -> str:
        """Return a note on what the colors mean and how much co-adaptation is hidden."""
        said = []
        if look.mode == "heat":
            said.append(
                "share of the exact CA per blend weight, {:g} (dark) to {:g} times the mean".format(*PER_WEIGHT_SCALE)
            )
        if look.hidden:
            shares = self.heat.shares
            said.append(
                f"{shares[self.heat.ranks >= 1 - look.hidden].sum() / shares.sum():.0%} of the exact CA are hidden"
            )
        return "; ".join(said)

    def _chosen(self, look: Look) -> TrainedModel:
        """Return the model with the Gaussians, colors and opacities of a look."""
        gaussians, regularizer = self.model.gaussians, self.model.regularizer
        if look.mode != "co-adaptation" and (look.mask or look.noise):  # in place of the test-time opacities
            drawn = _draws(look).regularize(gaussians.params(), torch.Generator(gaussians.means.device).manual_seed(0))
            gaussians, regularizer = replace(gaussians, opacity_logits=drawn.opacities.logit()), ""
        if look.mode == "heat":
            low, high = (end * self.heat.mean for end in PER_WEIGHT_SCALE)
            gaussians = colored_by(gaussians, self.heat.values, low, high)
        if look.hidden:
            gaussians = gaussians[self.heat.ranks < 1 - look.hidden]
        return replace(self.model, gaussians=gaussians, regularizer=regularizer)


def _draws(look: Look) -> Chain:
    """Return the regularizers whose draw or whose exact variance is shown."""
    dropped = look.mask or look.mode == "co-adaptation"
    return Chain(GaussianDropout(look.drop_rate if dropped else 0.0), OpacityNoise(look.noise))
