"""What the things cost that a training step leaves out by construction, or uses although it could do without."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from reference_trainer.model.rendering import render_gaussians
from reference_trainer.render import render
from reference_trainer.runs.run import model_of
from reference_trainer.studies.clocks import in_turns, processor_clock
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.randomness import stream
from reference_trainer.training.trainer import Trainer

__all__ = ["parts_of_a_step"]

_DROP_RATE = 0.2


def parts_of_a_step(trainer: Trainer, *, repeats: int = 7) -> dict[str, float]:
    """Time render, loss and gradients at the first training view, and how much more or less certain changes take.

    Args:
        trainer: with the model to measure; it does not change.
        repeats: rounds, in turns, of which the fastest counts.

    Returns:
        Seconds, of processors on a CPU: of the "step" (render, loss, gradients), and by how much each change differs.
    """
    gaussians, view, background = trainer.gaussians, trainer.views[0], trainer.background
    leaves = [x for _, x in gaussians.named() if x.numel()]
    generator = stream(trainer.config.seed, 0, "dropout", trainer.device)
    kept = torch.rand(len(gaussians), generator=generator, device=trainer.device) >= _DROP_RATE
    score, model = model_of(trainer).exact_ca_score(), model_of(trainer)

    def step(*, degree: int | None = None, depth: bool = False, opacities: Tensor | None = None) -> None:
        out = render_gaussians(gaussians, view.camera, background, opacities=opacities, sh_degree=degree, depth=depth)
        loss = photometric_loss(out.image, view.image)
        torch.autograd.grad(loss if out.depth is None else loss + 0 * out.depth.mean(), leaves, allow_unused=True)

    def without_background() -> None:
        g = gaussians
        out = render(g.means, g.quaternions, g.scales, g.opacities, view.camera, sh=g.sh)
        loss = photometric_loss(out.image, view.image)
        torch.autograd.grad(loss, leaves, allow_unused=True)

    calls: dict[str, Callable[[], object]] = {
        "step": step,
        "all bands left out": lambda: step(degree=0),
        "background left out": without_background,
        "depth added": lambda: step(depth=True),
        f"{_DROP_RATE:.0%} of the Gaussians dropped": lambda: step(opacities=gaussians.opacities * kept),
    }
    calls["exact moments added"] = lambda: score(model.gaussians.opacities, view)
    seconds = in_turns(calls, repeats, processor_clock(trainer.device))
    fastest = {name: min(times) for name, times in seconds.items()}
    fastest["exact moments added"] += fastest["step"]
    return {name: seconds - fastest["step"] * (name != "step") for name, seconds in fastest.items()}
