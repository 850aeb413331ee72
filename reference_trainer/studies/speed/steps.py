"""The speed of what surrounds a rendering: a training step, the structural similarity, and masked renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from kornia.metrics import ssim as kornia_ssim

from reference_trainer.evaluation.model import Model
from reference_trainer.model.gaussians import SH_C0, Gaussians, inverse_sigmoid
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import View
from reference_trainer.studies.speed.workloads import Workload
from reference_trainer.studies.timing import in_turns, now
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import photometric_loss, ssim_map
from reference_trainer.training.trainer import Trainer

__all__ = ["MASKS", "masked_renders", "similarity", "training_step"]

MASKS = 5
"""K of the paper's protocol."""

_DROP_RATE = 0.5
_PICTURE = (3, 189, 252)
_WINDOW = 11
_BANDS = 3  # of the spherical harmonics in the training step


def training_step(options: SceneOptions, *, repeats: int, device: torch.device) -> dict[str, Any]:
    """Time steps of the default training from the initial Gaussians, with all bands of the spherical harmonics.

    Args:
        options: the scene.
        repeats: number of timed steps of each kind.
        device: where to train.

    Returns:
        The scene's name, the size of its first picture, the number of Gaussians, and seconds of every repetition:
        "step" of whole steps, and "forward", "loss", "backward", "optimizer" of their parts, which leave out what the
        trainer does besides (counting for densification, the squared error, choosing the view).
    """
    trainer = Trainer(options.load(), TrainConfig(sh_degree=_BANDS, sh_every=1), device)
    while trainer.sh_degree < _BANDS:
        trainer.train_step()
    parts: dict[str, list[float]] = {name: [] for name in ("step", "forward", "loss", "backward", "optimizer")}
    for i in range(repeats + 1):  # the first round is not kept
        view = trainer.views[i % len(trainer.views)]
        times = [now(device)]
        trainer.train_step()
        times.append(now(device))
        out = render_gaussians(trainer.gaussians, view.camera, trainer.background, sh_degree=trainer.sh_degree)
        times.append(now(device))
        loss = photometric_loss(out.image, view.image, trainer.config.lambda_dssim)
        times.append(now(device))
        loss.backward()  # type: ignore[no-untyped-call]
        times.append(now(device))
        trainer.optimizer.step()
        times.append(now(device))
        if i:
            for name, start, end in zip(parts, times[:-1], times[1:], strict=True):
                parts[name].append(end - start)
    camera = trainer.views[0].camera
    return {
        "scene": trainer.scene.name,
        "width": camera.width,
        "height": camera.height,
        "gaussians": len(trainer.gaussians),
        "seconds": parts,
    }


def similarity(*, repeats: int, device: torch.device) -> dict[str, list[float]]:
    """Time value and gradient of the mean structural similarity of two pictures of 252 x 189 pixels.

    Returns:
        Seconds of every repetition: of "ssim_map", which the loss uses, and of "kornia".
    """
    generator = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, *_PICTURE, generator=generator).to(device)
    picture = first.requires_grad_()

    def ours() -> None:
        torch.autograd.grad(ssim_map(picture, second).mean(), picture)

    def kornias() -> None:
        torch.autograd.grad(kornia_ssim(picture[None], second[None], _WINDOW).mean(), picture)

    return in_turns({"ssim_map": ours, "kornia": kornias}, repeats, device)


def masked_renders(workload: Workload) -> dict[str, Callable[[], object]]:
    """Return what to time: as many plain renders as the paper's protocol has masks, and the protocol itself.

    The score leaves out half of the Gaussians in every render, draws the masks and takes the variance.

    Returns:
        Calls by name.
    """
    w = workload
    gaussians = Gaussians(
        means=w.means,
        log_scales=w.scales.log(),
        quaternions=w.quaternions,
        opacity_logits=inverse_sigmoid(w.opacities),
        sh_dc=((w.colors - 0.5) / SH_C0)[:, None],
        sh_rest=w.colors.new_zeros(len(w.colors), 0, 3),
    )
    model, view = Model(gaussians, w.colors.new_zeros(3)), View("workload", w.camera, w.target)
    score, opacities = model.ca_score(samples=MASKS, drop_rate=_DROP_RATE), gaussians.opacities

    @torch.no_grad()
    def plain() -> None:
        for _ in range(MASKS):
            model.render(opacities, view)

    return {f"{MASKS} renders": plain, f"score of {MASKS}": lambda: score(opacities, view, index=0)}
