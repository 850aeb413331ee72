"""Dropout and opacity noise for every code base that calls ``gsplat.rasterization``.

In a script of one's own, one line wraps the function:

    rasterization = regularized(gsplat.rasterization, GaussianDropout(0.2))

In a script that is not to be edited, :func:`install` replaces it before the script is loaded. The co-adaptation score
of a gsplat model is in :mod:`ca_reg.integrations.gsplat_model`.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["Installation", "Rasterization", "Regularized", "install", "load_gsplat", "regularized", "unregularized"]

Rasterization = Callable[..., tuple[Any, ...]]
"""``gsplat.rasterization``, or a function with its arguments that returns its ``info`` last."""

_HOLDERS = ("gsplat", "gsplat.rendering")  # the two public places that scripts import the function from


def regularized(
    rasterization: Rasterization, regularizer: nn.Module, *, generator: torch.Generator | None = None
) -> Regularized:
    """Wrap ``gsplat.rasterization`` so that the opacities pass through a regularizer.

    A call trains if the regularizer is in ``train()``, gradients are enabled, and the opacities require one; any other
    call evaluates, whatever the mode of the module: test views under ``no_grad`` get the scaled opacities of ``eval()``
    without a word from the script. All cameras of a call see the same draw. A schedule needs ``set_step``, as always.

    What a draw leaves at opacity 0 leaves no trace in density control: its ``info["radii"]`` are 0, in the shapes of
    gsplat 1.4 ([C, N]) and later ([C, N, 2]). In packed mode gsplat itself does not list it, from 1.5 on.

    Convention: activated opacities, [..., N]; several batches are drawn as one set of Gaussians.

    Args:
        rasterization: ``gsplat.rasterization`` or ``gsplat.rasterization_2dgs``, or a function with the same arguments.
        regularizer: from activated opacities (N,) to those to render; ``nn.Sequential`` for several.
        generator: source of the draws, passed to the regularizer, or to each member of an ``nn.Sequential``.

    Raises:
        TypeError: if ``rasterization`` has no argument ``opacities``, or ``regularizer`` is not a module.
        ValueError: if ``rasterization`` is regularized already.
        RuntimeError: at the first packed call in training, if gsplat lists Gaussians of opacity 0 (before 1.5).

    Example:
        >>> from ca_reg import GaussianDropout
        >>> def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, packed=True):
        ...     radii = torch.ones(1, len(opacities), 2, dtype=torch.int32)  # stands in for gsplat.rasterization
        ...     return opacities, opacities, {"radii": radii, "gaussian_ids": None}
        >>> rasterization = regularized(rasterization, GaussianDropout(0.5))
        >>> opacities = torch.full((6,), 0.8, requires_grad=True)
        >>> colors, _, info = rasterization(None, None, None, opacities, None, None, None, 8, 8)
        >>> torch.equal(info["radii"][0, :, 0] > 0, colors > 0)
        True
        >>> with torch.no_grad():
        ...     rasterization(None, None, None, opacities, None, None, None, 8, 8)[0]
        tensor([0.4000, 0.4000, 0.4000, 0.4000, 0.4000, 0.4000])
    """
    return Regularized(rasterization, regularizer, generator)


class Regularized:
    """A rasterization whose opacities pass through a regularizer; made by :func:`regularized`.

    Attributes:
        rasterization: the function underneath.
        regularizer: the module.
        trained: number of calls that were regularized as training.
        evaluated: number of calls that were rendered as evaluation.
    """

    def __init__(
        self,
        rasterization: Rasterization,
        regularizer: nn.Module,
        generator: torch.Generator | None = None,
        *,
        counts_steps: bool = False,
    ) -> None:
        if isinstance(rasterization, Regularized):
            raise ValueError(
                "this rasterization is regularized already, and opacities would be dropped twice: compose regularizers "
                "with nn.Sequential, or take its .rasterization."
            )
        if not isinstance(regularizer, nn.Module):
            raise TypeError(f"regularizer must be a torch module, got {type(regularizer).__name__}.")
        self._signature = inspect.signature(rasterization)
        if "opacities" not in self._signature.parameters:
            raise TypeError(f"expected gsplat.rasterization, got {rasterization!r}, which has no argument opacities.")
        self.rasterization = rasterization
        self.regularizer = regularizer
        self.trained = self.evaluated = 0
        self._generator = generator
        self._counts_steps = counts_steps
        self._packed_is_safe = False
        functools.update_wrapper(self, rasterization)

    def __call__(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Rasterize with regularized opacities; takes and returns what ``rasterization`` does."""
        bound = self._signature.bind(*args, **kwargs)
        opacities: Tensor = bound.arguments["opacities"]
        given = opacities.reshape(-1)
        trains = self.regularizer.training and torch.is_grad_enabled() and opacities.requires_grad
        used = self._train(given) if trains else self._evaluate(given)
        if used is not given:
            bound.arguments["opacities"] = used.view(opacities.shape)
        *images, info = self.rasterization(*bound.args, **bound.kwargs)
        # Several ranks exchange their Gaussians inside the call, after gsplat (1.5 on) has left out those of opacity 0.
        if trains and used is not given and not bound.arguments.get("distributed"):
            self._forget_undrawn(info, (used.detach() > 0).view(opacities.shape))
        return (*images, info)

    def _train(self, opacities: Tensor) -> Tensor:
        if self._counts_steps:
            for module in self.regularizer.modules():
                if callable(set_step := getattr(module, "set_step", None)):
                    set_step(self.trained)
        self.trained += 1
        return self._apply(opacities)

    def _evaluate(self, opacities: Tensor) -> Tensor:
        self.evaluated += 1
        with _evaluating(self.regularizer):
            return self._apply(opacities)

    def _apply(self, opacities: Tensor) -> Tensor:
        if self._generator is None:
            out: Tensor = self.regularizer(opacities)
            return out
        members = self.regularizer if isinstance(self.regularizer, nn.Sequential) else (self.regularizer,)
        for member in members:
            opacities = member(opacities, generator=self._generator)
        return opacities

    def _forget_undrawn(self, info: MutableMapping[str, Any], drawn: Tensor) -> None:
        """Zero the radii of Gaussians of opacity 0; ``drawn`` is [..., N]."""
        gaussians, radii = info.get("gaussian_ids"), info["radii"]
        if gaussians is None:
            per_camera = drawn.unsqueeze(-2)  # [..., 1, N]
            info["radii"] = radii * (per_camera if radii.ndim == per_camera.ndim else per_camera.unsqueeze(-1))
        elif not self._packed_is_safe:
            # Looked at once: on a GPU the look costs a wait, and it is the version of gsplat that decides.
            batches = info.get("batch_ids")
            listed = gaussians if batches is None else batches * drawn.shape[-1] + gaussians
            if not bool(drawn.reshape(-1)[listed.long()].all()):
                raise RuntimeError(
                    "this rasterization lists Gaussians of opacity 0 in packed mode, as gsplat before 1.5 does, and "
                    "density control would count them as seen: pass packed=False, or install gsplat>=1.5."
                )
            self._packed_is_safe = True


class Installation:
    """A replaced ``gsplat.rasterization``, to be undone by :meth:`uninstall` or at the end of a ``with`` block.

    Attributes:
        rasterization: what is in its place; counts the calls.
    """

    def __init__(self, rasterization: Regularized, replaced: dict[str, Any]) -> None:
        self.rasterization = rasterization
        self._replaced = replaced

    def uninstall(self) -> None:
        """Put back what was there; a second call does nothing."""
        while self._replaced:
            name, original = self._replaced.popitem()
            importlib.import_module(name).rasterization = original  # type: ignore[attr-defined]

    def __enter__(self) -> Installation:
        return self

    def __exit__(self, *_: object) -> None:
        self.uninstall()


def install(regularizer: nn.Module, *, generator: torch.Generator | None = None) -> Installation:
    """Replace ``gsplat.rasterization`` and ``gsplat.rendering.rasterization``, for scripts that are not edited.

    Do it before the script is imported: what has imported the name already keeps the old function. Nobody tells the
    regularizer the step of such a script, so its step is the number of training calls so far.

    Args:
        regularizer: as for :func:`regularized`.
        generator: as for :func:`regularized`.

    Raises:
        ImportError: if gsplat is missing.
        TypeError: as :func:`regularized`.
        ValueError: if it is installed already.

    Example:
        >>> import runpy
        >>> from ca_reg import GaussianDropout
        >>> with install(GaussianDropout(0.2)) as installation:  # doctest: +SKIP
        ...     runpy.run_path("simple_trainer.py", run_name="__main__")
        >>> installation.rasterization.trained  # doctest: +SKIP
        30000
    """
    replacement = Regularized(load_gsplat().rasterization, regularizer, generator, counts_steps=True)
    replaced = {name: importlib.import_module(name).rasterization for name in _HOLDERS}
    for name in _HOLDERS:
        importlib.import_module(name).rasterization = replacement  # type: ignore[attr-defined]
    return Installation(replacement, replaced)


def load_gsplat(device: torch.device | None = None) -> Any:
    """Return the module ``gsplat``.

    Args:
        device: of the tensors that it is going to render; None if nothing is rendered yet.

    Raises:
        ImportError: if it is missing; names the extra.
        RuntimeError: if the device is not a CUDA device.
    """
    if device is not None and device.type != "cuda":
        raise RuntimeError(f"gsplat renders on CUDA devices only, and the Gaussians are on {device}: move them there.")
    try:
        return importlib.import_module("gsplat")
    except ModuleNotFoundError as error:
        raise ImportError("this needs gsplat: pip install 'ca_reg[gsplat]' (and a CUDA device to run it).") from error


def unregularized(rasterization: Rasterization) -> Rasterization:
    """Return the function underneath if ``rasterization`` is regularized, else itself."""
    return rasterization.rasterization if isinstance(rasterization, Regularized) else rasterization


@contextmanager
def _evaluating(regularizer: nn.Module) -> Iterator[None]:
    """Put a module into ``eval()`` for a while; each of its parts gets its own mode back."""
    modes = [(module, module.training) for module in regularizer.modules()]
    regularizer.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
