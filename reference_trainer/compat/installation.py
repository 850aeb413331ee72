"""Put the stand-ins in the place of the CUDA extensions that a foreign repository imports."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

from reference_trainer.compat.cuda import cuda_on_cpu
from reference_trainer.compat.neighbors import neighbor_modules
from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.compat.repository import Interface, Outputs, read_interface

__all__ = ["install", "install_in_worker", "stand_in", "uninstall"]

_active = ExitStack()


def install(repository: str | Path, outputs: Outputs | None = None) -> tuple[str, ...]:
    """Let a repository's imports of its CUDA extensions find the stand-ins, until `uninstall`.

    Args:
        repository: its root; its source tells which variants it expects.
        outputs: what its rasterizer returns, if its source does not tell: 2 (colour, radii), 4 (colour, radii, depth,
            alpha), or three, the third of which is a "depth" or an "inverse-depth".

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
def stand_in(repository: str | Path, outputs: Outputs | None = None) -> Iterator[tuple[str, ...]]:
    """Let a repository run without CUDA: `install` within a block, with "cuda" mapped to the CPU.

    The extensions are ``diff_gaussian_rasterization`` (or ``diff_gaussian_rasterization_abs``) and ``simple_knn``. If
    there is a CUDA device, only they are replaced and "cuda" stays what it is. Modules of the repository that were
    imported within the block keep the stand-ins. Worker processes that start afresh, as those of data loaders do on
    macOS, find them as well: by a temporary folder at the end of the search path, which such processes inherit.

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
    modules = _modules(interface)
    present = [name for name in modules if name in sys.modules]
    if present:
        raise RuntimeError(
            f"{', '.join(present)} {'is' if len(present) == 1 else 'are'} imported already: start a new process, and "
            "install the stand-in before the repository is imported; or uninstall() an earlier one."
        )
    with cuda_on_cpu(), _importable(interface):
        sys.modules.update(modules)
        try:
            yield tuple(modules)
        finally:
            for name in modules:
                sys.modules.pop(name, None)


def install_in_worker(rasterizer: str, members: tuple[str, ...], neighbor_indices: bool) -> None:
    """Install the stand-ins in a worker process, for as long as it lives.

    Args:
        rasterizer: see `reference_trainer.compat.repository.Interface`.
        members: likewise.
        neighbor_indices: likewise.
    """
    _active.enter_context(cuda_on_cpu())
    sys.modules.update(_modules(Interface(rasterizer, members, neighbor_indices)))


def _modules(interface: Interface) -> dict[str, ModuleType]:
    """Make the modules that a repository imports, by name."""
    return {
        interface.rasterizer: rasterizer_module(interface.rasterizer, interface.members),
        **neighbor_modules(indices=interface.neighbor_indices),
    }


@contextmanager
def _importable(interface: Interface) -> Iterator[None]:
    """Let processes that inherit the search path import the stand-ins, but not their parent's objects."""
    with TemporaryDirectory(prefix="ca_reg_stand_in_") as folder:
        for name in (interface.rasterizer, "simple_knn"):
            # The import system hands out what stands in sys.modules once the file has run.
            text = f"from {__name__} import install_in_worker\n\ninstall_in_worker{tuple(interface)!r}\n"
            (Path(folder) / f"{name}.py").write_text(text, encoding="utf-8")
        sys.path.append(folder)
        try:
            yield
        finally:
            if folder in sys.path:
                sys.path.remove(folder)
