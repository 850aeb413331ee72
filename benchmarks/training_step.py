"""What a training step takes, whole and in parts, and what the score of a view takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise

import torch

from benchmarks.workloads import Workload
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.model.gaussians import SH_C0, Gaussians
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render.engine import using_engine
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.studies.study import Clock, in_turns
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.trainer import Trainer

__all__ = ["MASKS", "PARTS", "analytic_step", "scores", "step_parts"]

MASKS = 5
"""K of the paper's protocol."""

PARTS = ("renderer", "loss", "optimizer", "rest")

_CONFIG = TrainConfig(sh_degree=3, sh_every=1, dropout=0.2)
_DROP_RATE = 0.5


def step_parts(
    scene: Scene, engine: str, *, repeats: int, device: torch.device, clock: Clock
) -> dict[str, list[float]]:
    """Time steps of a training with dropout 0.2 from the initial Gaussians, with all bands of the spherical harmonics.

    Args:
        scene: what is trained.
        engine: what renders.
        repeats: number of timed steps of each kind.
        device: where to train.
        clock: seconds.

    Returns:
        Seconds of every repetition: "step" of whole steps, and `PARTS` of them: renderer and loss forward and backward,
        the optimizer, and the rest (draws, statistics for densification, the squared error, choosing the view), which
        is what the others leave of the step.
    """
    trainer = _trainer(scene, _CONFIG, device)
    found: dict[str, list[float]] = {name: [] for name in ("step", *PARTS)}
    with using_engine(engine):
        for i in range(repeats + 1):  # the first round is not kept
            seconds = _one_step(trainer, clock)
            for name, x in seconds.items() if i else ():
                found[name].append(x)
    return found


def _one_step(trainer: Trainer, clock: Clock) -> dict[str, float]:
    """Time a step, and the parts of another at the same view."""
    view = trainer.views[trainer.step % len(trainer.views)]
    times = [clock()]
    trainer.train_step()
    times.append(clock())
    opacities = trainer.regularizer(trainer.gaussians.opacities, generator=torch.Generator().manual_seed(trainer.step))
    times.append(clock())
    out = render_gaussians(
        trainer.gaussians, view.camera, trainer.background, opacities=opacities, sh_degree=trainer.sh_degree
    )
    times.append(clock())
    image = out.image.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(photometric_loss(image, view.image), image)
    times.append(clock())
    out.image.backward(gradient)  # type: ignore[no-untyped-call]
    times.append(clock())
    trainer.optimizer.step()
    times.append(clock())
    step, _, forward, loss, backward, optimizer = (b - a for a, b in pairwise(times))
    parts = {"renderer": forward + backward, "loss": loss, "optimizer": optimizer}
    return {"step": step, **parts, "rest": step - sum(parts.values())}


def analytic_step(
    scene: Scene, engine: str, *, repeats: int, device: torch.device, clock: Clock
) -> dict[str, list[float]]:
    """Time steps of the same training "sampled" and "analytic" in turns; see `step_parts`."""
    configs = {"sampled": _CONFIG, "analytic": dataclasses.replace(_CONFIG, analytic=True)}
    trainers = {name: _trainer(scene, config, device) for name, config in configs.items()}
    with using_engine(engine):
        return in_turns({name: trainer.train_step for name, trainer in trainers.items()}, repeats, clock)


def _trainer(scene: Scene, config: TrainConfig, device: torch.device) -> Trainer:
    """Return a training in which all bands are in use."""
    trainer = Trainer(scene, config, device)
    while trainer.sh_degree < config.sh_degree:
        trainer.train_step()
    return trainer


def scores(workload: Workload, engine: str) -> dict[str, Callable[[], object]]:
    """Return what to time: a plain render, the exact score of a view, and the paper's protocol with five masks.

    Every mask leaves out half of the Gaussians; drawing the masks and the variance are part of the score.

    Returns:
        Calls by name, each rendered by the engine.
    """
    w = workload
    gaussians = Gaussians(
        means=w.means,
        log_scales=w.scales.log(),
        quaternions=w.quaternions,
        opacity_logits=torch.logit(w.opacities),
        sh_dc=((w.colors - 0.5) / SH_C0)[:, None],
        sh_rest=w.colors.new_zeros(len(w.colors), 0, 3),
    )
    model, view = TrainedModel(gaussians, w.colors.new_zeros(3)), View("workload", w.camera, w.target)
    exact, sampled = model.exact_ca_score(drop_rate=_DROP_RATE), model.ca_score(samples=MASKS, drop_rate=_DROP_RATE)
    opacities = gaussians.opacities

    def by_engine(call: Callable[[], object]) -> Callable[[], object]:
        @torch.no_grad()
        def rendered() -> object:
            with using_engine(engine):
                return call()

        return rendered

    return {
        "render": by_engine(lambda: model.render(opacities, view)),
        "exact score": by_engine(lambda: exact(opacities, view)),
        # A new view every time: the protocol keeps what the masks of one view share.
        f"score, K = {MASKS}": by_engine(lambda: sampled(opacities, dataclasses.replace(view), index=0)),
    }
