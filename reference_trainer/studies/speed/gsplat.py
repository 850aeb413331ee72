"""gsplat's CUDA kernels on the workloads, where there are such: timed in turns with the renderer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.render.gsplat import load_gsplat_render
from reference_trainer.studies.speed.calls import Draw, gradients, image
from reference_trainer.studies.speed.workloads import Workload

__all__ = ["gsplat_calls", "gsplat_draw"]


def gsplat_draw(device: torch.device) -> Draw | None:
    """Return gsplat as something to time; None without gsplat or where there is no CUDA device.

    Example:
        >>> gsplat_draw(torch.device("cpu")) is None
        True
    """
    try:
        render = load_gsplat_render(device)
    except (ImportError, RuntimeError):
        return None

    def draw(parameters: Mapping[str, Tensor], camera: Camera) -> Tensor:
        p = parameters
        return render(p["means"], p["quaternions"], p["scales"], p["opacities"], camera, colors=p["colors"]).image

    return draw


def gsplat_calls(workload: Workload) -> dict[str, Callable[[], object]]:
    """Return what to time, "gsplat forward" and "gsplat forward+backward", by name; nothing without gsplat."""
    draw = gsplat_draw(workload.means.device)
    if draw is None:
        return {}
    return {
        "gsplat forward": lambda: image(draw, workload),
        "gsplat forward+backward": lambda: gradients(draw, workload),
    }
