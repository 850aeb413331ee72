"""Host time of the plug-in: what a hook adds to a call of a rasterizer, as a multiple of the bare module call.

    python -m benchmarks.hooks

The rasterizer does nothing, and there are few Gaussians, so that the processor's work for a call is all that is left,
which is the same on a card. All is measured in turns, in one process, in processor time; the smallest of many counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ca_reg import GaussianDropout
from ca_reg.integrations.gsplat import regularized
from ca_reg.integrations.inria import RasterizerHook

__all__ = ["host_times", "main"]

COUNT = 64


class GaussianRasterizer(nn.Module):
    """The interface of the INRIA family."""

    def forward(
        self, means3D: Tensor, means2D: Any, opacities: Tensor, shs: Any = None, colors_precomp: Any = None,
        scales: Any = None, rotations: Any = None, cov3D_precomp: Any = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        return opacities, self.radii


def rasterization(
    means: Any, quats: Any, scales: Any, opacities: Tensor, colors: Any, viewmats: Any, Ks: Any, width: int,
    height: int, packed: bool = True, sh_degree: int | None = None, covars: Any = None,
) -> tuple[Any, ...]:  # fmt: skip
    """The interface of gsplat."""
    return opacities, opacities, {"radii": GaussianRasterizer.radii_per_camera, "gaussian_ids": None}


def host_times(rounds: int = 300, calls: int = 10) -> dict[str, float]:
    """Return microseconds of a bare module call (with the radii), and what the hooks add to a rasterizer's."""
    means = torch.zeros(COUNT, 3, requires_grad=True)
    logits = torch.zeros(COUNT, 1, requires_grad=True)
    opacities = logits.sigmoid()
    flat = opacities.reshape(-1)
    radii = torch.ones(COUNT, dtype=torch.int32)
    GaussianRasterizer.radii, GaussianRasterizer.radii_per_camera = radii, radii.view(1, -1, 1).repeat(1, 1, 2)
    kind = type("Hooked", (GaussianRasterizer,), {"forward": GaussianRasterizer.forward})
    rasterizer, hooked_rasterizer, dropout = GaussianRasterizer(), kind(), GaussianDropout(0.2)
    wrapped = regularized(rasterization, GaussianDropout(0.2))
    hook = RasterizerHook(GaussianDropout(0.2), rasterizer=kind, patience=0)
    step = 0

    def bare() -> None:
        dropout(opacities)
        dropout.mask_radii(radii)

    def render(rasterizer: nn.Module = rasterizer) -> None:
        rasterizer(means3D=means, means2D=None, shs=None, opacities=opacities, scales=means, rotations=means)

    def hooked() -> None:
        nonlocal step
        step += 1
        hook.step(step)
        render(hooked_rasterizer)

    def gsplat() -> None:
        rasterization(means, means, means, flat, None, None, None, 8, 8, sh_degree=3)

    def gsplat_regularized() -> None:
        wrapped(means, means, means, flat, None, None, None, 8, 8, sh_degree=3)

    works = {"bare": bare, "render": render, "hooked": hooked, "gsplat": gsplat, "wrapped": gsplat_regularized}
    least = dict.fromkeys(works, float("inf"))

    def measure(name: str, work: Callable[[], None]) -> None:
        begun = time.process_time()
        for _ in range(calls):
            work()
        least[name] = min(least[name], (time.process_time() - begun) / calls * 1e6)

    with hook:
        for _ in range(rounds):
            for name, work in works.items():
                measure(name, work)
    return {
        "bare": least["bare"],
        "INRIA": least["hooked"] - least["render"],
        "gsplat": least["wrapped"] - least["gsplat"],
    }


def main() -> None:
    """Print the table."""
    found = host_times()
    print("| host time | us | times the bare call |\n|:--|---:|---:|")
    for name, value in found.items():
        print(f"| {name} | {value:.0f} | {value / found['bare']:.2f} |")


if __name__ == "__main__":
    main()
