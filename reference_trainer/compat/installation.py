"""Put the stand-ins in the place of the CUDA extensions that a foreign repository imports, or of gsplat's functions."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

from reference_trainer.compat.cuda import cuda_on_cpu
from reference_trainer.compat.extensions import fused_ssim, make_module, neighbor_modules
from reference_trainer.compat.gsplat_functions import gsplat_functions
from reference_trainer.compat.rasterizer import rasterizer_module
from reference_trainer.compat.repository import Interface, Outputs, read_interface

__all__ = ["install", "install_in_worker", "stand_in", "uninstall"]

_active = ExitStack()


def install(repository: str | Path | None = None, outputs: Outputs | None = None) -> tuple[str, ...]:
    """Do what `stand_in` does, until `uninstall`; same arguments and exceptions. Returns the names of the modules."""
    names = _active.enter_context(stand_in(repository, outputs))
    return names


def uninstall() -> None:
    """Undo `install`; nothing happens if nothing is installed."""
    _active.close()


@contextmanager
def stand_in(repository: str | Path | None = None, outputs: Outputs | None = None) -> Iterator[tuple[str, ...]]:
    """Let a repository of the INRIA family, or scripts that call gsplat, run without CUDA within a block.

    The extensions of the INRIA family are ``diff_gaussian_rasterization`` (or ``diff_gaussian_rasterization_abs``) and
    ``simple_knn``. For gsplat its functions are replaced (`gsplat_functions`), and ``fused_ssim``, which its trainer
    imports. "cuda" is mapped to the CPU; if there is a CUDA device, it stays what it is. Modules that were imported
    within the block keep the stand-ins. Worker processes that start afresh, as those of data loaders do on macOS, find
    the extensions as well: by a temporary folder at the end of the search path, which such processes inherit.

    Args:
        repository: its root; its source tells which variants of the extensions it expects. None for gsplat.
        outputs: what its rasterizer returns, if its source does not tell: 2 (colour, radii), 4 (colour, radii, depth,
            alpha), or three, the third of which is a "depth" or an "inverse-depth".

    Yields:
        The names of the modules.

    Raises:
        RuntimeError: if the extensions, or stand-ins for them, are imported already.
        ValueError: if the variant cannot be told.
        ImportError: if gsplat is missing, for which this is to be done.

    Example:
        >>> with stand_in("a/repository", outputs=2) as modules:
        ...     from diff_gaussian_rasterization import GaussianRasterizer
        >>> modules
        ('diff_gaussian_rasterization', 'simple_knn', 'simple_knn._C')
        >>> with stand_in():  # doctest: +SKIP
        ...     import simple_trainer  # gsplat's
    """
    interface = None if repository is None else read_interface(Path(repository), outputs)
    modules = _modules(interface)
    present = [name for name in modules if name in sys.modules]
    if present:
        raise RuntimeError(
            f"{', '.join(present)} {'is' if len(present) == 1 else 'are'} imported already: start a new process, and "
            "install the stand-in before the repository is imported; or uninstall() an earlier one."
        )
    with cuda_on_cpu(), _importable(modules, interface), nullcontext() if interface else gsplat_functions():
        sys.modules.update(modules)
        try:
            yield tuple(modules)
        finally:
            for name in modules:
                sys.modules.pop(name, None)


def install_in_worker(interface: tuple[str, tuple[str, ...], bool] | None) -> None:
    """Install the stand-ins in a worker process, for as long as it lives.

    Args:
        interface: the fields of `reference_trainer.compat.repository.Interface`; None for gsplat.
    """
    _active.enter_context(cuda_on_cpu())
    sys.modules.update(_modules(interface and Interface(*interface)))


def _modules(interface: Interface | None) -> dict[str, ModuleType]:
    """Make the modules that are imported, by name."""
    if interface is None:
        return {"fused_ssim": make_module("fused_ssim", fused_ssim=fused_ssim)}
    return {
        interface.rasterizer: rasterizer_module(interface.rasterizer, interface.members),
        **neighbor_modules(indices=interface.neighbor_indices),
    }


@contextmanager
def _importable(modules: Iterable[str], interface: Interface | None) -> Iterator[None]:
    """Let processes that inherit the search path import the stand-ins, but not their parent's objects."""
    with TemporaryDirectory(prefix="ca_reg_stand_in_") as folder:
        # The import system hands out what stands in sys.modules once the file has run.
        text = f"from {__name__} import install_in_worker\n\ninstall_in_worker({interface and tuple(interface)!r})\n"
        for name in modules:
            if "." not in name:
                (Path(folder) / f"{name}.py").write_text(text, encoding="utf-8")
        sys.path.append(folder)
        try:
            yield
        finally:
            if folder in sys.path:
                sys.path.remove(folder)
