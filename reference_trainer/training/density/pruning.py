"""Density control that prunes by more than opacity: co-adapting Gaussians, and those on which models disagree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ca_reg import attribute
from ca_reg._check import check_count
from ca_reg.neighbors import nearest_distance
from ca_reg.regularizers.segs import SEGSNoise
from reference_trainer.evaluation.shares import all_but_highest, blend_weights, share_per_weight
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.model.rendering import arguments, render_gaussians
from reference_trainer.render import splat
from reference_trainer.render.densification import SMALLEST_SPREAD, longer_radii
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.virtual_cameras import pseudo_cameras
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.density.adaptive import AdaptiveDensity
from reference_trainer.training.density.operations import refuse_not_finite
from reference_trainer.training.interruption import TrainingStoppedError
from reference_trainer.training.model_state import ModelState
from reference_trainer.training.randomness import stream

__all__ = ["CoPruning", "SelfEnsembling", "SharePruning"]


class SharePruning(AdaptiveDensity):
    """`AdaptiveDensity` that also prunes by the share of the exact score per blend weight.

    Every ``every`` steps between ``densify_from`` and ``densify_until`` this removes the ``fraction`` of the Gaussians
    whose `ca_reg.attribute` shares, summed over the training views, are highest relative to their blend weights; those
    without a share stay. Not a published method: in docs/studies.md, where finished models were pruned, this criterion
    lowered the score most at equal count. Each time costs an exact score, its shares and a backward pass per training
    view.

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; shares and weights are those of the plain
    opacities, without draws or test-time scaling.

    Args:
        every: positive number of steps.
        fraction: of the Gaussians, in (0, 1).
        drop_rate: of the score, in (0, 1).
    """

    def __init__(self, every: int = 500, fraction: float = 0.02, drop_rate: float = 0.5) -> None:
        check_count(every, "every", minimum=1, hint=": density control without it is 'adaptive'")
        for name, value in (("fraction", fraction), ("drop_rate", drop_rate)):
            if not 0 < value < 1:
                raise ValueError(f"{name} must be in (0, 1), got {value}.")
        self.every, self.fraction, self.drop_rate = every, fraction, drop_rate

    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Prune by share as well, after all else; the other Gaussians keep their statistics."""
        super().before_step(optimizer, step)
        if self.config.densify_from < step < self.config.densify_end and step % self.every == 0:
            refuse_not_finite(optimizer, step)
            self.select(optimizer, all_but_highest(self.shares_per_weight(optimizer, step), self.fraction))

    def shares_per_weight(self, optimizer: GaussianOptimizer, step: int) -> Tensor:
        """Return each current Gaussian's share per blend weight over the training views, shape (N,), float64."""
        model = TrainedModel(
            optimizer.gaussians.map(torch.Tensor.detach),
            self.scene.background.to(self.device),
            sh_degree=self.config.sh_degree_at(step),
        )
        views = [view.to(self.device) for view in self.scene.train]
        score, opacities = model.exact_ca_score(drop_rate=self.drop_rate), model.gaussians.opacities
        shares = torch.stack([attribute(score, model.shares, opacities, view).shares for view in views]).sum(0)
        return share_per_weight(shares, blend_weights(model, views))


class CoPruning(AdaptiveDensity):
    """`AdaptiveDensity` that also prunes where the models disagree (CoR-GS, Zhang et al. 2024, Sec. 3.3).

    Every ``every`` steps after ``densify_from``, to the end of the training, Gaussians that lack a neighbor nearer than
    ``distance`` in any other model are pruned; all models are compared before any is pruned. It needs ``models=2``.
    Defaults are the source's for LLFF (jiaw-z/CoR-GS 1db13a4, train.py, lines 284-301).

    Dropped Gaussians: not counted in the gradients, as in `AdaptiveDensity`; neighbors are sought among all.

    Args:
        distance: world units, positive: 5 in the worlds of LLFF, 10 in those of DTU.
        every: positive number of steps.
    """

    needs = frozenset({"models"})

    def __init__(self, distance: float = 5.0, every: int = 500) -> None:
        if not distance > 0:
            raise ValueError(f"distance must be positive, got {distance}.")
        check_count(every, "every", minimum=1, hint=": density control without it is 'adaptive'")
        self.distance, self.every = distance, every

    def together(self, models: Sequence[ModelState], step: int) -> None:
        """Prune all models."""
        if not (step > self.config.densify_from and step % self.every == 0):
            return
        for model in models:
            refuse_not_finite(model.optimizer, step)
        means = [model.gaussians.means.detach() for model in models]
        # All are compared before any is pruned: the order of the models must not matter.
        keeps = [
            torch.stack([nearest_distance(own, other) < self.distance for other in means if other is not own]).all(0)
            for own in means
        ]
        for model, keep in zip(models, keeps, strict=True):
            if not bool(keep.any()):
                raise TrainingStoppedError(
                    f"no Gaussian has one of another model within {self.distance:g} after step {step}: raise distance, "
                    "which is in world units."
                )
            model.density.select(model.optimizer, keep)


_BOX = 5  # pixels, over which deviations are averaged


class SelfEnsembling(CoPruning):
    """`CoPruning` that perturbs the second model where the first is uncertain (SE-GS, Zhao et al., ICCV 2025).

    Every ``every`` steps the first model is rendered at the same `pseudo_cameras`. From ``start`` to ``stop`` it is
    uncertain where the standard deviation over the last three of these times, averaged over the channels and 5 x 5
    pixels, exceeds ``least`` and is among the ``share`` of a picture's largest. The other model's Gaussians whose
    center lies within such a picture, nearer to an uncertain pixel than the root of their radius in pixels, get the
    noise of `SEGSNoise`, for good, and the optimizer state of all Gaussians' geometry is cleared. (The root, because
    the source compares a squared distance with a radius.) Two pictures of every view are kept, also in checkpoints.

    Defaults are the source's for LLFF (sailor-z/SE-GS 43668d7, train_llff.py); one thing differs: Gaussians too faint
    to be rendered, below 1/255, are not perturbed. Dropped Gaussians: as in `CoPruning`; the plain model is rendered.

    Args:
        distance: as in `CoPruning`.
        every: steps between prunings and between renders.
        first: ratio of the noise at ``start``.
        last: ratio of the noise at ``stop``.
        start: first step with noise; at least twice ``every``, for three pictures.
        stop: first step without noise again.
        views: number of cameras.
        share: greatest share of a picture's pixels that is uncertain, in (0, 1).
        least: smallest standard deviation of an uncertain pixel, in colors of [0, 1].
    """

    def __init__(
        self,
        distance: float = 5.0,
        every: int = 500,
        first: float = 0.08,
        last: float = 0.02,
        start: int = 2_000,
        stop: int = 9_500,
        views: int = 24,
        share: float = 0.05,
        least: float = 0.01,
    ) -> None:
        super().__init__(distance, every)
        self.noise = SEGSNoise(first, last, start, stop)
        check_count(views, "views", minimum=1)
        if not 0 < share < 1 or not least >= 0:
            raise ValueError(f"expected share in (0, 1) and least >= 0, got {share} and {least}.")
        self.start = max(start, 2 * every)  # for three pictures
        self.stop, self.views, self.share, self.least = stop, views, share, least

    def begin(self, config: TrainConfig, scene: Scene, device: torch.device, count: int) -> None:
        """Place the cameras."""
        super().begin(config, scene, device, count)
        if self.index == 0:
            draw = pseudo_cameras(scene)
            self.background = scene.background.to(device)
            self.cameras = [draw(stream(config.seed, i, "self_ensembling/view", device)) for i in range(self.views)]
            self.images = torch.zeros(2, self.views, 3, self.cameras[0].height, self.cameras[0].width, device=device)

    @torch.no_grad()
    def together(self, models: Sequence[ModelState], step: int) -> None:
        """Prune all models, render the first and perturb the others."""
        super().together(models, step)
        if step % self.every or not self.start - 2 * self.every <= step < self.stop:
            return
        degree = self.config.sh_degree_at(step)
        first = [
            render_gaussians(models[0].gaussians, camera, self.background, sh_degree=degree).image
            for camera in self.cameras
        ]
        images = torch.cat([self.images, torch.stack(first)[None]])
        self.images = images[1:].clone()
        if step >= self.start:
            where = self.uncertain(images)
            for number, model in enumerate(models[1:]):
                generator = stream(self.config.seed, step, f"self_ensembling/{number}", self.device)
                self.perturb(model, self.under(model.gaussians, where), step, generator)

    def uncertain(self, images: Tensor) -> Tensor:
        """Return where images (T, V, 3, H, W) of V views at T times differ, shape (V, H, W), bool."""
        deviation = avg_pool2d(images.std(0).mean(1), _BOX, stride=1, padding=_BOX // 2)
        pixels = deviation[0].numel()
        # Above the limit lie a `share` of the pixels, or fewer where deviations are below `least`.
        limit = deviation.flatten(1).kthvalue(pixels - int(self.share * pixels), dim=1).values
        return deviation > limit.clamp(min=self.least)[:, None, None]

    def under(self, gaussians: Gaussians, uncertain: Tensor) -> Tensor:
        """Return which Gaussians lie at uncertain pixels (V, H, W) of any camera, shape (N,), bool."""
        found = torch.zeros(len(gaussians), dtype=torch.bool, device=uncertain.device)
        for camera, where in zip(self.cameras, uncertain, strict=True):
            splats = splat(**arguments(gaussians), camera=camera, sh_degree=0)
            centers, pixels = splats.projection.means, where.nonzero().flip(1)
            if len(pixels):
                inside = ((centers >= 0) & (centers < centers.new_tensor([camera.width, camera.height]))).all(1)
                radii = longer_radii(splats.projection.covariances, SMALLEST_SPREAD)
                near = nearest_distance(centers, pixels.to(centers)).square() < radii
                found[splats.indices[inside & near]] = True
        return found

    def perturb(self, model: ModelState, chosen: Tensor, step: int, generator: torch.Generator) -> None:
        """Add the noise of a step to the chosen Gaussians, (N,) bool, of a model."""
        x = model.gaussians.params(step=step)
        noisy = self.noise.replay(x, self.noise.draw(x, generator))
        assert noisy.means is not None
        assert noisy.scales is not None
        assert noisy.quaternions is not None
        geometry = {
            "means": noisy.means,
            "log_scales": noisy.scales.log(),
            "quaternions": noisy.quaternions,
            "opacity_logits": noisy.opacities.logit(eps=1e-6),
        }
        # Overwritten in place: the optimizer keeps its Gaussians, but forgets where they were heading.
        every = dict(model.gaussians.named())
        model.optimizer.relocate(chosen.nonzero()[:, 0], Gaussians.from_named(every | geometry)[chosen])
        model.optimizer.forget(slice(None), *geometry)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the statistics, and the pictures if this is the first model."""
        return super().state_dict() | ({} if self.index else {"pictures": self.images})

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the statistics and pictures."""
        super().load_state_dict({name: x for name, x in state.items() if name != "pictures"})
        if self.index == 0:
            self.images = state["pictures"]
