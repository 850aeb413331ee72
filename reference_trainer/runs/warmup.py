"""Compile the renderer's loops in advance, with a progress bar, instead of at the first training step."""

from __future__ import annotations

import functools
import logging
import time
from contextlib import suppress
from dataclasses import replace

import torch

from ca_reg.functional import Multiplier
from reference_trainer.progress import progress_bar
from reference_trainer.render import describe_engine, render_moments, variance_shares
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.dense import dense_points
from reference_trainer.scenes.images import resize_image
from reference_trainer.scenes.scene import View
from reference_trainer.threads import threads_for
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

__all__ = ["step_seconds", "warm_up"]

_log = logging.getLogger(__name__)
_UNTIMED, _TIMED = 3, 9  # steps


@functools.cache
def warm_up(*, points: bool = False) -> tuple[str, ...]:
    """Use every loop once per process, if the CPU engine is the loops; return the names of those that were compiled.

    A training step of each kind and a score of each kind compile exactly the variants of the loops that are needed, and
    with ``points`` a dense start does; those in the disk cache are loaded from it.
    """
    if describe_engine("cpu") == "torch":
        return ()
    from reference_trainer.compiled.compiling import describe_compilation, reported_to

    names: list[str] = []
    # Without a total: a loop is compiled once for each kind of arguments, unless that is in the cache.
    with progress_bar(delay=1e9, leave=False, bar_format="loop {n_fmt}{postfix}, {elapsed}") as bar:

        def note(name: str, folder: str | None) -> None:
            if not names:
                _log.info(describe_compilation(folder))
                bar.delay = 0.0
            names.append(name)
            bar.set_postfix_str(name, refresh=False)
            bar.update()

        with reported_to(note):
            _use_everything(points)
    return tuple(names)


def step_seconds(width: int, height: int, device: str = "cpu") -> float:
    """Time a training step on this machine as it is now: photographs of this size, one Gaussian for ten pixels.

    Call `warm_up` first, or the time includes compilation.
    """
    scene = synthetic_scene(width=40, height=30, points=max(10, width * height // 10))
    views = tuple(
        View(view.name, view.camera.resized(width, height), resize_image(view.image, width, height))
        for view in scene.train
    )
    config = TrainConfig(dropout=0.2, loss="photometric + smooth_depth(0.1)")  # as two of three steps of sparse
    trainer = Trainer(replace(scene, train=views), config, device)
    with threads_for(width * height):
        for number in range(_UNTIMED + _TIMED):
            if number == _UNTIMED:
                begun = time.perf_counter()
            trainer.train_step()
    return (time.perf_counter() - begun) / _TIMED


def _use_everything(points: bool) -> None:
    """Take a training step of each kind and compute each score on a scene of a few pixels; ``points``: measure some."""
    scene = synthetic_scene(width=8, height=6, points=20)
    if points:
        with suppress(ValueError):  # so few pixels give too few
            dense_points(scene.train)
    plain = TrainConfig(iterations=1, dropout=0.2)
    kinds = {"analytic": True}, {"density": "absgrad"}, {"loss": "photometric + smooth_depth(0.001)"}
    for config in (plain, *(replace(plain, **kind) for kind in kinds)):
        trainer = Trainer(scene, config)
        trainer.train_step()
    model, view = model_of(trainer), trainer.views[0]
    opacities = model.gaussians.opacities.detach().requires_grad_()
    splats, multiplier = model.splats(opacities, view), Multiplier.dropout(0.5)
    moments = render_moments(splats, multiplier)
    (moments.variance.sum() + moments.alpha_mean.sum()).backward()  # type: ignore[no-untyped-call]
    model.ca_score(samples=2)(model.gaussians.opacities.detach(), view)
    variance_shares(splats, multiplier, torch.ones(splats.lists.height, splats.lists.width))
