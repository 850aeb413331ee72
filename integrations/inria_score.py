"""The co-adaptation score for INRIA-style code bases: their `render` as a render callable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from ca_reg.types import RenderFn, Rendering, read_rendering

from ._override import override
from ._rasterizer import rasterizer_classes, white_alpha

__all__ = ["render_fn"]


def render_fn(
    render: Callable[..., Any], gaussians: Any, pipe: Any, background: Tensor, *, rasterizer: type | None = None
) -> RenderFn:
    """Turn the ``render`` of an INRIA-style code base into a render callable for :class:`ca_reg.CAScore`.

    The opacities are replaced on their way into the rasterizer, so neither the model nor ``render`` is modified, and a
    :class:`~ca_reg.integrations.inria.RasterizerHook` leaves these renders alone. Image and alpha are those that
    ``render`` returns, the alpha if it is named (the paper's code, Binocular3DGS, CoR-GS, DNGaussian). Else a second
    pass with the same opacities measures it, white on black: a depth is never mistaken for an alpha.

    Args:
        render: ``render(view, gaussians, pipe, background)`` of the code base.
        gaussians: its model.
        pipe: its pipeline settings.
        background: color, shape (3,).
        rasterizer: the class that ``render`` uses; by default the installed ones.

    Returns:
        A callable ``(opacity, view) -> Rendering(image (3, H, W), alpha (H, W))``.

    Raises:
        ImportError: when called, if no rasterizer is installed and none was given.
        RuntimeError: when called, if ``render`` does not call the rasterizer exactly once.
        ValueError: when called, if ``render`` does not rasterize as many Gaussians as there are opacities, or returns
            no alpha and the rasterizer takes no ``colors_precomp``.

    Example:
        >>> import torch
        >>> from ca_reg import CAScore
        >>> class GaussianRasterizer(torch.nn.Module):
        ...     def forward(self, means3D, means2D, opacities):
        ...         return opacities.mean().expand(3, 4, 5), torch.ones(len(means3D), dtype=torch.int32)
        >>> def render(view, gaussians, pipe, background):
        ...     image, radii = GaussianRasterizer()(gaussians, None, torch.full((9, 1), 0.5))
        ...     return {"render": image, "alpha": image[:1]}
        >>> fn = render_fn(render, torch.zeros(9, 3), None, torch.zeros(3), rasterizer=GaussianRasterizer)
        >>> fn(torch.full((9, 1), 0.9), "a view").alpha.mean().item()
        0.899...
        >>> result = CAScore(fn, threshold=0.0)(torch.full((9, 1), 0.9), "a view")
    """

    def overridden(opacity: Tensor, view: Any) -> Rendering:
        rasterizers = rasterizer_classes() if rasterizer is None else [rasterizer]
        with override(rasterizers, opacity) as calls:
            image, alpha = read_rendering(render(view, gaussians, pipe, background))
            if len(calls) != 1:
                names = ", ".join(rasterizer.__qualname__ for rasterizer in rasterizers)
                raise RuntimeError(
                    f"render called {names} {len(calls)} times, expected once; pass the class it uses as "
                    "rasterizer=..., and a render function that makes one picture."
                )
            return Rendering(image, white_alpha(calls[0]) if alpha is None else alpha)

    return overridden
