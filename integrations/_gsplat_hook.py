"""The hook of the launcher for scripts that call gsplat."""

from __future__ import annotations

import torch
from torch import nn

from ._tally import Tally
from .gsplat import Installation, install

__all__ = ["GsplatHook"]


class GsplatHook:
    """:func:`~ca_reg.integrations.gsplat.install` with what the launcher asks of a hook.

    Args:
        regularizer: as for ``install``.
        seed: of the draws, which leave the global random numbers alone.
        patience: as for ``install``.
    """

    def __init__(self, regularizer: nn.Module, *, seed: int, patience: int) -> None:
        self._arguments = regularizer, seed, patience
        self._installation: Installation | None = None

    def install(self) -> GsplatHook:
        """Replace gsplat's functions; return the hook."""
        regularizer, seed, patience = self._arguments
        device = "cuda" if torch.cuda.is_available() else "cpu"
        generator = torch.Generator(device).manual_seed(seed)
        self._installation = install(regularizer, generator=generator, patience=patience)
        return self

    def uninstall(self) -> None:
        """Put gsplat's functions back."""
        if self._installation is not None:
            self._installation.uninstall()

    @property
    def tally(self) -> Tally:
        """What was done so far."""
        return Tally() if self._installation is None else self._installation.tally

    def problem(self) -> str | None:
        """Say what went wrong unnoticed, and the way out; None if all is well."""
        return None if self._installation is None else self._installation.problem()
