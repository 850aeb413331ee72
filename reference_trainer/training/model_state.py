"""One model in training: the Gaussians that it starts from, and the base class of every density control."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from ca_reg import Chain
from ca_reg.neighbors import rms_neighbor_distance
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer
from reference_trainer.model.rendering import arguments
from reference_trainer.render import ViewSplats, splat
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.config import TrainConfig

__all__ = ["DensityStrategy", "ModelState", "initial_gaussians", "seen_by_any"]


def initial_gaussians(scene: Scene, config: TrainConfig, device: torch.device | str = "cpu") -> Gaussians:
    """Make one isotropic Gaussian per point, as wide as the distance to its neighbors times ``config.initial_scale``.

    If the scene has a model to start from, its Gaussians are taken as they are, their spherical harmonics cut or padded
    with zeros to ``config.sh_degree``.
    ``device`` renders what tells which are seen.

    Raises:
        ValueError: if only seen points are to be taken and there are none.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> scene = synthetic_scene(width=16, height=12, points=50)
        >>> len(initial_gaussians(scene, TrainConfig()))
        50
    """
    if scene.start is not None:
        bands = (config.sh_degree + 1) ** 2 - 1
        rest = scene.start.sh_rest[:, :bands]
        start = replace(scene.start, sh_rest=pad(rest, (0, 0, 0, bands - rest.shape[1])))
    else:
        start = Gaussians.from_points(
            scene.points.positions,
            scene.points.colors,
            rms_neighbor_distance(scene.points.positions) * config.initial_scale,
            sh_degree=config.sh_degree,
            opacity=config.initial_opacity,
        )
    if config.initial_points == "all":
        return start
    seen = seen_by_any(start, scene.train, device)
    if not bool(seen.any()):
        raise ValueError(
            f"no initial Gaussian of scene {scene.name!r} has a pixel in a training view: give other points."
        )
    return start[seen]


@torch.no_grad()
def seen_by_any(gaussians: Gaussians, views: tuple[View, ...], device: torch.device | str = "cpu") -> Tensor:
    """Return which Gaussians have a pixel in some view, shape (N,), bool. The others never receive a gradient.

    All are on the CPU, and so is the result; ``device`` renders.
    """
    gaussians = gaussians.to(device)
    seen = torch.zeros(len(gaussians), dtype=torch.bool, device=device)
    for view in views:
        splats = splat(**arguments(gaussians), camera=view.camera.to(device), sh_degree=0)
        seen[splats.indices[splats.touched]] = True
    return seen.cpu()


class DensityStrategy(abc.ABC):
    """Adds and removes Gaussians between the steps; custom strategies are subclasses.

    It is made from its arguments alone and told of the training by `begin`. Every step the trainer calls `before_step`,
    then `observe` for every render that trains, then updates the Gaussians. What it counts must be in `state_dict`, so
    that a resumed training is the same.

    Gaussians that a regularizer dropped are not rendered: `observe` must not count them as seen. If they were counted
    with their gradient of zero, a threshold would in effect rise by 1 / (1 - p).

    Attributes:
        needs: what it requires: ``"absgrad"`` of the renderer, for ``splats.means.absgrad``, the sums of
            absolute gradients; ``"models"`` of the training, at least two.
        resets: whether it obeys the ``opacity_reset`` settings.
        index: which of the training's models it controls, the first being 0.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    resets: ClassVar[bool] = False
    index: int = 0

    config: TrainConfig
    scene: Scene
    extent: float
    large: float
    device: torch.device

    def begin(self, config: TrainConfig, scene: Scene, device: torch.device, count: int) -> None:
        """Prepare for a training.

        Args:
            config: all settings.
            scene: its extent in world units is the unit of sizes.
            device: of the Gaussians.
            count: their number.
        """
        # Every model has its own random splits: those of seeds below 2^32 never meet.
        self.config = replace(config, seed=(config.seed + (self.index << 32)) % 2**63)
        self.scene, self.extent, self.device = scene, scene.extent, device
        self.large = config.dense_fraction * self.extent  # what is larger is split, what is smaller cloned
        self.reset(count)

    def is_due(self, step: int) -> bool:
        """Whether the schedule densifies before this step."""
        every = self.config.densify_every
        return bool(every) and self.config.densify_from < step < self.config.densify_end and step % every == 0

    def reset(self, count: int) -> None:  # noqa: B027 (not every strategy counts)
        """Start counting anew, for ``count`` Gaussians."""

    @abc.abstractmethod
    def before_step(self, optimizer: GaussianOptimizer, step: int) -> None:
        """Change the set of Gaussians before the step with this number, the first being 0.

        Before a step and not after it, so that between steps the model is always optimized: a clone lays a second splat
        over the first until further steps have adapted to it.

        Raises:
            TrainingStoppedError: if the Gaussians are not finite, or none is left.
        """

    def select(self, optimizer: GaussianOptimizer, keep: Tensor) -> None:
        """Keep some Gaussians, (N,) bool, with all that is counted of them."""
        optimizer.select(keep)

    def together(self, models: Sequence[ModelState], step: int) -> None:  # noqa: B027
        """Change models by comparing them with each other: pruning what another one lacks, for example.

        Called once a step, of the first model's strategy, after `before_step` of every model's. Most
        strategies look at one model alone and do nothing here.
        """

    def observes(self, step: int) -> bool:
        """Whether `observe` is to be called at a step, with what the strategy needs of the renderer."""
        return True

    def observe(self, splats: ViewSplats, camera: Camera) -> None:  # noqa: B027
        """Count a render whose gradients have been computed.

        Args:
            splats: what was rendered; ``splats.means.grad`` is the gradient per pixel of the projected centers.
            camera: of the render.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return the counts as float32 tensors by name."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:  # noqa: B027
        """Restore what `state_dict` returned."""


class ModelState:
    """Gaussians with an optimizer, density control and regularizers of their own; a training has one, or several.

    All models of a training start from the same points and diverge by their random numbers: every model has its own for
    the splits of density control and for the draws of regularizers and loss terms.

    Args:
        scene: with the points to start from.
        config: all settings.
        density: its density control; prepared here.
        regularizer: its regularizers.
        device: where to train.
        index: which of the models it is; the first, 0, is the one that is measured and written.

    Attributes:
        label: prefix of the labels of the model's random streams.

    Raises:
        ValueError: as `initial_gaussians`.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> from reference_trainer.training.assembly import make_density, make_regularizer
        >>> scene, config = synthetic_scene(width=16, height=12, points=50), TrainConfig()
        >>> state = ModelState(scene, config, make_density(config), make_regularizer(config))
        >>> len(state.gaussians)
        50
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        density: DensityStrategy,
        regularizer: Chain,
        *,
        device: torch.device | str = "cpu",
        index: int = 0,
    ) -> None:
        # The label names random streams: with another word than "field", trainings would come out differently.
        self.label = f"field {index}/" if index else ""
        self.regularizer = regularizer
        learns, start = regularizer.learns, initial_gaussians(scene, config, device)
        known = start.learned  # of a model with the same regularizers
        learned = {name: known.get(name, torch.full((len(start),), float(x.start))) for name, x in learns.items()}
        start = replace(start, learned=learned)
        # The means move in the world's units, everything else in units of its own.
        rates = {
            "means": config.means_rate_at(0) * scene.extent,
            "log_scales": config.scales_rate,
            "quaternions": config.quaternions_rate,
            "opacity_logits": config.opacity_rate,
            "sh_dc": config.color_rate,
            "sh_rest": config.color_rate / 20,
            **{name: learned.rate for name, learned in learns.items()},
        }
        self.optimizer = GaussianOptimizer(start.to(device), rates)
        self.density = density
        density.begin(config, scene, torch.device(device), len(start))

    @property
    def gaussians(self) -> Gaussians:
        """The model as it stands."""
        return self.optimizer.gaussians

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, as nested dicts of tensors."""
        found = {"statistics": self.density.state_dict(), "regularizer": dict(self.regularizer.state_dict())}
        return found | self.optimizer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: if the regularizers refuse their part.
        """
        self.optimizer.load_state_dict(dict(state))
        # For the size of the loaded model; its counts follow.
        self.density.reset(len(self.gaussians))
        self.density.load_state_dict(state["statistics"])
        try:
            self.regularizer.load_state_dict(state["regularizer"])
        except RuntimeError as error:
            raise ValueError(str(error)) from error
