"""Distillation: what several trained models show in the mean, at cameras that nobody took, as a target."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.regularizers import parse
from ca_reg.schedules import Schedule
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.ply import load_ply
from reference_trainer.scenes.scene import Scene, Viewpoint
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.training.losses.photometric import check_lambda, photometric_loss
from reference_trainer.training.losses.term import WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["Distillation"]

_KEPT = 32
"""Targets that are not rendered again: three photographs have 27 cameras, half a megapixel takes 8 MB."""


class Distillation(WeightedTerm):
    """``weight`` times the photometric loss against the mean render of trained models, where nobody photographed.

    Where few photographs look, trainings with different seeds err in different places: the mean of their renders is
    nearer to the truth than any of them. A model that starts from one of them (``init``) and is trained on for a few
    hundred steps with this term beside ``photometric`` takes most of that over, with no more Gaussians than it had
    (knowledge distillation, Hinton et al. 2015, arXiv:1503.02531). At each step one of the `unseen_views` is drawn, and
    rendered with a draw of the regularizer; the target is rendered with the test-time opacities. Density control does
    not see these renders. A step takes two to three times as long; the targets of 32 cameras are kept.

    Args:
        members: 3DGS .ply files of the models, in the world of the scene, with plain or test-time opacities.
        weight: at least 0, or a schedule.
        lambda_dssim: weight of the structural term, in [0, 1].

    Raises:
        ValueError: when the first step is taken, if a file holds no model, or says that it was trained with somebody's
            own regularizer, which is not imported.
        FileNotFoundError: likewise, if there is no such file. A finished run is measured without them.

    Example:
        >>> from reference_trainer.training.losses import LOSSES
        >>> (term,) = LOSSES.make("distillation('runs/a/point_cloud.ply', 'runs/b/point_cloud.ply')")
        >>> len(term.members)
        2
    """

    analytic = True  # it renders draws of its own

    def __init__(self, *members: str, weight: float | Schedule = 1.0, lambda_dssim: float = 0.2) -> None:
        super().__init__(weight)
        check_lambda(lambda_dssim)
        self.members, self.lambda_dssim = members, lambda_dssim
        self._models: list[TrainedModel] = []  # read when first asked for
        self._shown: dict[int, Tensor] = {}  # colors over black, and what they let through, by the number of the camera

    def begin(self, scene: Scene) -> None:
        """Choose the cameras; raises a ValueError if there is no member, or fewer than two training views."""
        if not self.members:
            raise ValueError("distillation needs .ply files of models to learn from, best two: distillation('a.ply').")
        self.views = unseen_views(scene)
        self._brightest = max(1.0, *(view.image.max().item() for view in scene.train))  # over 1 by an exposure

    def value(self, step: Step) -> Tensor:
        """Compare the model with the mean of the members at one camera."""
        device = step.image.device
        self._models = self._models or [_member(path, torch.zeros_like(step.background)) for path in self.members]
        generator = step.generator("distillation")
        number = int(torch.randint(len(self.views), (), generator=generator, device=device))
        view = self.views[number].to(device)
        params = step.regularizer.regularize(step.gaussians.params(view.camera, step=step.number), generator)
        target = self._target(number, view, step.background)
        return photometric_loss(step.render(view.camera, params).image, target, self.lambda_dssim)

    @torch.no_grad()
    def _target(self, number: int, view: Viewpoint, background: Tensor) -> Tensor:
        """Return the mean of what the members show at a camera."""
        shown = self._shown.get(number)
        if shown is None:
            of_all = [each.test_rendering(view) for each in self._models]
            shown = torch.stack([torch.cat([each.image, 1 - each.alpha[None]]) for each in of_all]).mean(dim=0)
            if len(self._shown) < _KEPT:
                self._shown[number] = shown
        return (shown[:3] + shown[3] * background[:, None, None]).clamp(0, self._brightest)


def _member(path: str, black: Tensor) -> TrainedModel:
    """Return a model as it is rendered at test time, over black."""
    model = load_ply(path)
    scaled = model.for_rendering or model.opacity_scale != 1
    if not scaled:
        try:
            parse(model.regularizer, imports=False)
        except ValueError as error:
            raise ValueError(f"{path} does not say how it is rendered: {error} Give its PLY for viewers.") from error
    gaussians = model.gaussians.map(lambda x: x.to(black))
    return TrainedModel(gaussians, black, model.regularizer, model.step, for_rendering=scaled)
