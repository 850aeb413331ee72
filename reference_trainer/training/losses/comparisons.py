"""Terms that compare renders: over draws of dropout, between models, and with what a mask hides."""

from __future__ import annotations

from itertools import permutations
from typing import Literal

from torch import Tensor

from ca_reg import GaussianDropout
from ca_reg._check import check_count
from ca_reg.functional import Multiplier, expected_squared_error
from ca_reg.schedules import Schedule
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.virtual_cameras import VIRTUAL_VIEWS, pseudo_cameras
from reference_trainer.training.losses.photometric import check_lambda, photometric_loss
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["CoAdaptation", "CoRegularization", "Consistency", "StraightThrough"]


class CoAdaptation(WeightedTerm):
    """``weight`` times the mean variance of the colors when each Gaussian is dropped independently, with rate ``p``.

    The variance needs no photograph, so it can be taken at virtual views as well. At the training view an analytic step
    has computed its variance already, which costs nothing more; else the moments are rendered, which takes about as
    long as the render.

    Args:
        weight: at least 0, or a schedule.
        p: drop rate in [0, 1); in an analytic step the regularizer's own draws count at the training view instead.
        where: ``"training"``, the view of the step, or a camera drawn anew at each step: between two training cameras
            on a ``"line"`` or on an ``"arc"`` (`cameras_between`), on an arc extended by half its length ``"beyond"``
            either, or in their ``"box"`` (`pseudo_cameras`).
        every: the term acts once in so many steps, multiplied by their number, so that ``weight`` is the mean per step.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("co_adaptation(between(3.0, 200), where='arc', every=4)")
        >>> [number for number in range(190, 210) if term.acts(number)]
        [200, 204, 208]
    """

    needs = frozenset({"moments"})
    analytic = True

    def __init__(self, weight: float | Schedule = 1.0, p: float = 0.5, where: str = "training", every: int = 1) -> None:
        super().__init__(weight)
        self.multiplier = Multiplier.dropout(p)
        if where not in ("training", *VIRTUAL_VIEWS):
            raise ValueError(f"where must be training, {', '.join(VIRTUAL_VIEWS)}, got {where!r}.")
        check_count(every, "every", minimum=1, hint=": a term without steps is left out")
        self.where, self.every = where, every

    def begin(self, scene: Scene) -> None:
        """Prepare the virtual cameras."""
        if self.where != "training":
            self.draw = VIRTUAL_VIEWS[self.where](scene)

    def acts(self, number: int) -> bool:
        """Return whether the term is due at a step, with a weight that is not 0."""
        return number % self.every == 0 and super().acts(number)

    def value(self, step: Step) -> Tensor:
        """Return the mean variance, times the number of steps that it stands for."""
        camera, variance = step.view.camera, step.variance
        if self.where != "training":
            camera, variance = self.draw(step.generator("co_adaptation")), None
        # An analytic step has rendered the variance of its own draws; other cameras need a render.
        if variance is None:
            variance = step.moments(camera, self.multiplier).variance
        return self.every * variance.mean()


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
        # Without a regularizer the step has rendered the plain model already.
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


class CoRegularization(WeightedTerm):
    """``weight`` times the photometric loss between the renders of all models, at a pseudo view (CoR-GS, 2024).

    At each step one of the `pseudo_cameras` is rendered with each of the models, plain, and each compared with the
    others as if they were photographs, mean over the others. Density control does not see these renders. It needs
    ``models=2``, and costs a render of every model.

    Args:
        weight: at least 0, or a schedule. The source uses 1 from step 500 on with LLFF, from 2,000 on with DTU:
            ``between(1.0, 500)``.
        lambda_dssim: weight of the structural term, in [0, 1].
    """

    needs = frozenset({"models"})
    analytic = True

    def __init__(self, weight: float | Schedule = 1.0, lambda_dssim: float = 0.2) -> None:
        super().__init__(weight)
        check_lambda(lambda_dssim)
        self.lambda_dssim = lambda_dssim

    def begin(self, scene: Scene) -> None:
        """Prepare the pseudo cameras."""
        self.draw = pseudo_cameras(scene)

    def value(self, step: Step) -> Tensor:
        """Compare all models, once: at the step of the first."""
        zero = step.image.new_zeros(())
        if step is not step.siblings[0]:
            return zero
        # One camera for all models, drawn from the first one's stream.
        camera = self.draw(step.generator("co_regularization"))
        images = [each.render(camera).image for each in step.siblings]
        losses = [photometric_loss(own, other.detach(), self.lambda_dssim) for own, other in permutations(images, 2)]
        return sum(losses, start=zero) / (len(images) - 1)


class StraightThrough(WeightedTerm):
    """`photometric_loss` whose value is that of one render and whose gradients flow through another; an experiment.

    In place of ``photometric``, beside a dropout. A step of dropout takes two things from its dropped render: the
    error, and the derivatives, in which Gaussians behind a dropped one count for more. Each can be had without the
    other. ``"full"``: the error of the full render, the derivatives of the dropped one, so that hidden Gaussians learn
    as with dropout. What is then missing, for a squared error, is the gradient of the variance over masks, which is
    what the co-adaptation score measures: ``2 E[J'(I - T)] = 2 E[J]'(E[I] - T) + d sum(var I)`` for renders I,
    derivatives J and the photograph T. ``"dropped"``: the error of the dropped render, the derivatives of the full one.

    Density control counts the render through which the gradients flow. The full render is that of the step's parameters
    before any regularizer; a dropout should therefore be compensated, so that both renders have about the same mean.

    Args:
        error: the render whose error is taken, ``"full"`` or ``"dropped"``.
        lambda_dssim: weight of the structural term, in [0, 1].
        weight: of the whole, at least 0, or a schedule.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("straight_through('full')")
        >>> term.error
        'full'
    """

    def __init__(
        self,
        error: Literal["full", "dropped"] = "full",
        lambda_dssim: float = 0.2,
        *,
        weight: float | Schedule = 1.0,
    ) -> None:
        super().__init__(weight)
        if error not in ("full", "dropped"):
            raise ValueError(f"error must be full or dropped, got {error!r}.")
        check_lambda(lambda_dssim)
        self.error, self.lambda_dssim = error, lambda_dssim

    def value(self, step: Step) -> Tensor:
        """Compare one render of the step's view with its photograph, and send the gradients through the other."""
        full = step.render(step.view.camera, observed=self.error == "dropped").image
        seen, through = (full, step.image) if self.error == "full" else (step.image, full)
        # The value is that of `seen`, the derivative that of `through`: the difference is a constant.
        return photometric_loss(through + (seen - through).detach(), step.view.image, self.lambda_dssim)
