"""DropoutGS's consistency of the full render with one that has dropped Gaussians."""

from __future__ import annotations

from torch import Tensor

from ca_reg import GaussianDropout
from ca_reg.functional import Multiplier, expected_squared_error
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.photometric import check_lambda, photometric_loss
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Consistency"]


class Consistency(WeightedTerm):
    """``weight`` times the difference between the full render and one that drops Gaussians (DropoutGS, CVPR 2025).

    Both renders are of the view of the step, and both learn. Sampled, as in the source: L1 + D-SSIM to a render with
    one draw of dropout at the constant rate p, its survivors not compensated. ``exact``: the expectation over all draws
    of the squared error, ``(mean - full)^2 + variance``, mean over pixels and channels, without a draw. The full render
    is the step's own, or an additional one if a regularizer has changed that. Density control sees the step's own only.

    Args:
        p: drop rate in [0, 1). The source uses 0.4 on LLFF, 0.3 on DTU, 0.1 to 0.2 on Blender.
        weight: at least 0, or a schedule. The source uses 0.2 on LLFF, 0.5 on DTU.
        lambda_dssim: weight of the structural term, in [0, 1]; of the sampled form only.
        exact: take the expected squared error instead of a draw.

    Raises:
        ValueError: if one is out of range.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> _, term = LOSSES.make("photometric + consistency(0.3, 0.5, exact=True)")
        >>> term.p, term.weight, term.exact
        (0.3, 0.5, True)
    """

    analytic = True

    def __init__(
        self,
        p: float = 0.4,
        weight: float | Schedule = 0.2,
        lambda_dssim: float = 0.2,
        *,
        exact: bool = False,
    ) -> None:
        super().__init__(weight)
        self.dropout = GaussianDropout(p)
        check_lambda(lambda_dssim)
        self.p, self.lambda_dssim, self.exact = p, lambda_dssim, exact
        self.needs = frozenset({"moments"} if exact else ())

    def acts(self, number: int) -> bool:
        """Return whether neither the rate nor the weight at this step is 0."""
        return self.p > 0 and super().acts(number)

    def value(self, step: Step) -> Tensor:
        """Compare the two renders."""
        camera = step.view.camera
        untouched = step.rendering is not None and step.rendered is step.params
        full = step.image if untouched else step.render(camera).image
        if self.exact:
            moments = step.moments(camera, Multiplier.dropout(self.p))
            return expected_squared_error(moments.mean, moments.variance, full).mean()
        params = self.dropout.regularize(step.params, step.generator("consistency"))
        dropped = step.render(camera, params).image
        # The loss is symmetric, but differentiable in its first argument only: its gradient each way, its value once.
        one = photometric_loss(full, dropped.detach(), self.lambda_dssim)
        other = photometric_loss(dropped, full.detach(), self.lambda_dssim)
        return one + other - other.detach()
