"""The co-adaptation score of models of INRIA-style code bases: their `render` as a render callable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ca_reg.types import RenderFn, Rendering, read_rendering

from ._override import override
from ._rasterizer import ForwardCall, rasterizer_classes, white_alpha

__all__ = ["render_fn"]

_UNKNOWN, _NOT_THERE = -1, -2


def render_fn(
    render: Callable[..., Any], gaussians: Any, pipe: Any, background: Tensor, *, rasterizer: type | None = None
) -> RenderFn:
    """Turn the ``render`` of an INRIA-style code base into what :class:`ca_reg.CAScore` takes.

    The opacities are replaced on their way into the rasterizer, so neither the model nor ``render`` is touched, and a
    :class:`~ca_reg.integrations.inria.RasterizerHook` leaves these renders alone. The image is the one that ``render``
    returns. The alpha is

    - the one that ``render`` returns by name (the paper's code, Binocular3DGS, CoR-GS, DNGaussian);
    - else the member of the rasterizer's tuple that equals the alpha of a second, white-on-black pass with the same
      opacities. That pass is made until the member is known, and then no more (FSGS);
    - else, if no member equals it, that of such a pass each time (3DGS, MVGS, AbsGS, DropGaussian). A depth is thus
      never taken for an alpha, whatever the length of the tuple.

    Args:
        render: ``render(view, gaussians, pipe, background)`` of the code base.
        gaussians: its model.
        pipe: its pipeline settings.
        background: colour, shape (3,).
        rasterizer: the class that ``render`` uses; by default those that are installed.

    Returns:
        A callable ``(opacity, view) -> Rendering(image (3, H, W), alpha (H, W))``.

    Raises:
        ImportError: when called, if no rasterizer is installed and none was given.
        RuntimeError: when called, if ``render`` does not call the rasterizer exactly once.
        ValueError: when called, if ``render`` does not rasterize as many Gaussians as there are opacities.

    Example:
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
    return _OverriddenRender(render, gaussians, pipe, background, rasterizer)


class _OverriddenRender:
    """See :func:`render_fn`."""

    def __init__(
        self, render: Callable[..., Any], gaussians: Any, pipe: Any, background: Tensor, rasterizer: type | None
    ) -> None:
        self._render = render
        self._arguments = (gaussians, pipe, background)
        self._rasterizer = rasterizer
        self._alpha_at = _UNKNOWN

    def __call__(self, opacity: Tensor, view: Any) -> Rendering:
        """Render a view with these activated opacities, (N,) or (N, 1)."""
        rasterizers = rasterizer_classes() if self._rasterizer is None else [self._rasterizer]
        with override(rasterizers, opacity) as calls:
            image, alpha = read_rendering(self._render(view, *self._arguments))
            if len(calls) != 1:
                names = ", ".join(rasterizer.__qualname__ for rasterizer in rasterizers)
                raise RuntimeError(
                    f"render called {names} {len(calls)} times, expected once; pass the class it uses as "
                    "rasterizer=..., and a render function that makes one picture."
                )
            call, returned = calls[0]
            return Rendering(image, self._alpha(call, returned, image) if alpha is None else alpha)

    def _alpha(self, call: ForwardCall, returned: Sequence[Tensor], image: Tensor) -> Tensor:
        """Take the alpha out of the rasterizer's tuple, or measure it."""
        size = image.shape[1:]
        if self._alpha_at >= 0:
            return returned[self._alpha_at].reshape(size)
        white = white_alpha(call)
        if self._alpha_at == _UNKNOWN and bool(white.any()):
            equal = [i for i, x in enumerate(returned) if _is_plane(x, size) and _is_same(x.reshape(size), white)]
            self._alpha_at = equal[0] if len(equal) == 1 else _NOT_THERE
        return white


def _is_plane(x: Any, size: torch.Size) -> bool:
    """Whether this is a picture with one channel."""
    return isinstance(x, Tensor) and x.is_floating_point() and x.shape in (size, (1, *size))


def _is_same(x: Tensor, alpha: Tensor) -> bool:
    """Whether these are the same but for rounding; the next best candidate, a depth, is far from it."""
    return torch.allclose(x.detach(), alpha, rtol=0.0, atol=1e-4)
