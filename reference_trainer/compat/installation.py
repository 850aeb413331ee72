"""Put the stand-ins in the place of the CUDA extensions that a foreign repository imports."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType

from reference_trainer.compat.cuda import cuda_on_cpu
from reference_trainer.compat.neighbors import neighbor_modules
from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.compat.repository import read_interface

__all__ = ["install", "stand_in", "uninstall"]

_active = ExitStack()


def install(repository: str | Path, outputs: int | None = None) -> tuple[str, ...]:
    """Let a repository's imports of its CUDA extensions find the stand-ins, until `uninstall`.

    Args:
        repository: its root; its source tells which variants it expects.
        outputs: how many values its rasterizer returns, if its source does not tell: 2 (colour, radii), 3 (colour,
            radii, inverse depth) or 4 (colour, radii, depth, alpha).

    Returns:
        The names of the modules.

    Raises:
        RuntimeError: if the extensions, or stand-ins for them, are imported already.
        ValueError: if the variant cannot be told.
    """
    names = _active.enter_context(stand_in(repository, outputs))
    return names


def uninstall() -> None:
    """Undo `install`; nothing happens if nothing is installed."""
    _active.close()


@contextmanager
def stand_in(repository: str | Path, outputs: int | None = None) -> Iterator[tuple[str, ...]]:
    """Let a repository run without CUDA: `install` within a block, with "cuda" mapped to the CPU.

    The extensions are ``diff_gaussian_rasterization`` (or ``diff_gaussian_rasterization_abs``) and ``simple_knn``. If
    there is a CUDA device, only they are replaced and "cuda" stays what it is. Modules of the repository that were
    imported within the block keep the stand-ins.

    Args:
        repository: as for `install`.
        outputs: as for `install`.

    Yields:
        The names of the modules.

    Raises:
        RuntimeError: as `install`.
        ValueError: as `install`.

    Example:
        >>> with stand_in("a/repository", outputs=2) as modules:
        ...     from diff_gaussian_rasterization import GaussianRasterizer
        >>> modules
        ('diff_gaussian_rasterization', 'simple_knn', 'simple_knn._C')
    """
    interface = read_interface(Path(repository), outputs)
    modules: dict[str, ModuleType] = {
        interface.rasterizer: rasterizer_module(interface.rasterizer, interface.outputs),
        **neighbor_modules(indices=interface.neighbor_indices),
    }
    present = [name for name in modules if name in sys.modules]
    if present:
        raise RuntimeError(
            f"{', '.join(present)} {'is' if len(present) == 1 else 'are'} imported already: start a new process, and "
            "install the stand-in before the repository is imported; or uninstall() an earlier one."
        )
    with cuda_on_cpu():
        sys.modules.update(modules)
        try:
            yield tuple(modules)
        finally:
            for name in modules:
                sys.modules.pop(name, None)
