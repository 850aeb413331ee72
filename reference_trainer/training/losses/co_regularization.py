"""CoR-GS's comparison of a training's models with each other, at views without a photograph."""

from __future__ import annotations

from itertools import permutations

from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.scenes.pseudo import pseudo_cameras
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.losses.photometric import check_lambda, photometric_loss
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["CoRegularization"]


class CoRegularization(WeightedTerm):
    """``weight`` times the photometric loss between the renders of all models, at a pseudo view (CoR-GS, 2024).

    At each step one of the `pseudo_cameras` is rendered with each of the models, plain, and each compared with the
    others as if they were photographs, mean over the others. Density control does not see these renders. It needs
    ``models=2``, and costs a render of every model.

    Args:
        weight: at least 0, or a schedule. The source uses 1 from step 500 on with LLFF, from 2,000 on with DTU:
            ``between(1.0, 500)``.
        lambda_dssim: weight of the structural term, in [0, 1].

    Raises:
        ValueError: if one is out of range, or the scene has no `pseudo_cameras`.
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
        camera = self.draw(step.generator("co_regularization"))
        images = [each.render(camera).image for each in step.siblings]
        losses = [photometric_loss(own, other.detach(), self.lambda_dssim) for own, other in permutations(images, 2)]
        return sum(losses, start=zero) / (len(images) - 1)
