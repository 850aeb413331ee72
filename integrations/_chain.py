"""How every hook applies regularizers: in order, in the mode of the call, and with one rule for what was dropped."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor, nn

from ca_reg import OpacityNoise

__all__ = ["Chain"]


class Chain:
    """Regularizers, applied one after the other.

    A Gaussian counts as dropped if the mask ``keep`` of a module says so. A module without that attribute drops what
    it sets to 0; only :class:`~ca_reg.OpacityNoise` does not, as in the paper's code.

    Args:
        regularizer: a module from activated opacities (N,) or (N, 1) to those to render, or ``nn.Sequential`` of them.

    Raises:
        TypeError: if it is no module.

    Example:
        >>> from ca_reg import GaussianDropout
        >>> opacity, keep = Chain(nn.Sequential(GaussianDropout(0.5), OpacityNoise(0.8))).draw(torch.full((9,), 0.6))
        >>> bool((opacity[~keep] == 0).all())
        True
    """

    def __init__(self, regularizer: nn.Module) -> None:
        self.modules = _flatten(regularizer)

    @property
    def drops(self) -> bool:
        """Whether a member may drop Gaussians."""
        return any(not isinstance(module, OpacityNoise) for module in self.modules)

    @property
    def perturbs(self) -> bool:
        """Whether a member adds opacity noise."""
        return any(isinstance(module, OpacityNoise) for module in self.modules)

    def without_generator(self) -> list[str]:
        """Return the types of the members whose ``forward`` takes no argument ``generator``."""
        return [type(module).__name__ for module in self.modules if not _takes_generator(module)]

    def set_step(self, step: int) -> None:
        """Tell the training step to the members that ask for it."""
        for module in self.modules:
            _set_step(module, step)

    def draw(self, opacity: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor | None]:
        """Regularize for training; every member does so in the mode that it is in.

        Args:
            opacity: activated opacities, shape (N,) or (N, 1).
            generator: source of the draws, passed to every member; None for the global one.

        Returns:
            The opacities to render, the very same tensor if there is nothing to do; and what was not dropped, shape
            (N,) bool, None if that is all.
        """
        keep: Tensor | None = None
        for module in self.modules:
            before = opacity
            opacity = module(before) if generator is None else module(before, generator=generator)
            if opacity is not before and (kept := _kept(module, before, opacity)) is not None:
                keep = kept if keep is None else keep & kept
        return opacity, keep

    def evaluate(self, opacity: Tensor, step: int | None = None, generator: torch.Generator | None = None) -> Tensor:
        """Return the opacities of a test render, shape as given.

        The members themselves are not touched, so that another thread, or an exception at any place, finds them as
        they were: copies that share their tensors do the work.

        Args:
            opacity: activated opacities, shape (N,) or (N, 1).
            step: the training step; that of the members if it is None.
            generator: passed to every member; None for none.
        """
        for module in map(_evaluating, self.modules):
            if step is not None:
                _set_step(module, step)
            opacity = module(opacity) if generator is None else module(opacity, generator=generator)
        return opacity


def _flatten(module: nn.Module) -> list[nn.Module]:
    """Return the members of a chain in order."""
    if not isinstance(module, nn.Module):
        raise TypeError(f"regularizer must be a torch module, got {type(module).__name__}.")
    if isinstance(module, nn.Sequential) and type(module).forward is nn.Sequential.forward:
        return [member for child in module for member in _flatten(child)]
    return [module]


def _takes_generator(module: nn.Module) -> bool:
    """Whether ``forward`` has an argument of that name, or takes any."""
    parameters = inspect.signature(module.forward).parameters
    return "generator" in parameters or any(x.kind is x.VAR_KEYWORD for x in parameters.values())


def _set_step(module: nn.Module, step: int) -> None:
    """Tell a module and its parts the step, if they have a `set_step`."""
    for part in module.modules():
        if callable(set_step := getattr(part, "set_step", None)):
            set_step(step)


def _kept(module: nn.Module, before: Tensor, after: Tensor) -> Tensor | None:
    """Return what a module has not dropped, (N,) bool; None if it dropped nothing."""
    if hasattr(module, "keep"):
        keep: Any = module.keep
        return None if keep is None else keep.reshape(-1)
    if isinstance(module, OpacityNoise):
        return None  # what its clamp leaves at 0 is still counted as seen, as in the paper's code
    return ((after.detach() != 0) | (before.detach() == 0)).reshape(-1)


def _evaluating(module: nn.Module) -> nn.Module:
    """Return a copy in ``eval()`` that shares all tensors with the module."""
    module = getattr(module, "_orig_mod", module)  # a compiled module calls the original, in its mode
    twin = object.__new__(type(module))
    vars(twin).update(vars(module))
    parts = {name: None if part is None else _evaluating(part) for name, part in module._modules.items()}
    vars(twin).update(training=False, _modules=parts)
    return twin
