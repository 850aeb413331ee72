"""Installing the stand-ins for the CUDA extensions that a foreign repository imports, or for gsplat's functions."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import NamedTuple
from unittest.mock import patch

from ca_reg.integrations._sources import read_folder
from reference_trainer.compat.cuda import cuda_on_cpu
from reference_trainer.compat.encoders import FreqEncoder, GridEncoder, SHEncoder
from reference_trainer.compat.extensions import distCUDA2, fused_ssim, make_module
from reference_trainer.compat.gsplat_functions import gsplat_functions
from reference_trainer.compat.rasterizer import rasterizer_module

__all__ = ["install_in_worker", "stand_in"]

NVIDIA_SMI = """#!/bin/sh
printf 'GPU 00000000:00:00.0\\n    FB Memory Usage\\n'
for line in Total Reserved Used Free; do printf '        %s : 0 MiB\\n' $line; done
"""

_in_worker = ExitStack()


class Rasterizers(NamedTuple):
    """The rasterizers that a repository expects: names by module, and what they return, if specified."""

    modules: dict[str, set[str]]
    outputs: tuple[str, ...] | None


@contextmanager
def stand_in(
    repository: str | Path | None = None, outputs: Sequence[str] | None = None, rasterizer: str | None = None
) -> Iterator[tuple[str, ...]]:
    """Let a repository of the INRIA family, or scripts that call gsplat, run without CUDA within a block.

    The extensions of the INRIA family are ``diff_gaussian_rasterization``, the other modules that the repository
    imports a ``...Rasterizer`` from, unless they are its own, ``simple_knn``, ``fused_ssim``, and the encoders
    ``gridencoder``, ``shencoder`` and ``freqencoder``. For gsplat its functions are replaced (`gsplat_functions`), and
    ``fused_ssim``, which its trainer imports. "cuda" is mapped to the CPU unless there is a CUDA device. Modules that
    were imported within the block keep the stand-ins. Worker processes that start afresh, such as those of data loaders
    on macOS, find the extensions as well: in a temporary folder at the end of the search path, which they inherit.

    Args:
        repository: its root folder, whose sources are read; None for gsplat.
        outputs: what its rasterizer returns, in this order, if the names that it assigns them to do not tell:
            ``("image", "radii", "depth", "alpha")``, say; see `reference_trainer.compat.outputs.kinds_of`.
        rasterizer: one more rasterizer, as ``module:Class``.

    Yields:
        The names of the modules.

    Raises:
        RuntimeError: if the extensions, or stand-ins for them, are imported already.
        ImportError: if gsplat's functions are to be replaced and gsplat is missing.

    Example:
        >>> with stand_in("a/repository") as modules:
        ...     from diff_gaussian_rasterization import GaussianRasterizer
        >>> modules[:2]
        ('diff_gaussian_rasterization', 'simple_knn')
        >>> with stand_in():  # doctest: +SKIP
        ...     import simple_trainer  # gsplat's
    """
    expected = None if repository is None else _expected(Path(repository), outputs, rasterizer)
    modules = _modules(expected)
    present = [name for name in modules if name in sys.modules]
    if present:
        raise RuntimeError(
            f"{', '.join(present)} {'is' if len(present) == 1 else 'are'} imported already: start a new process, and "
            "install the stand-in before the repository is imported; or end an earlier one."
        )
    with cuda_on_cpu(), _importable(modules, expected), nullcontext() if expected else gsplat_functions():
        sys.modules.update(modules)
        try:
            yield tuple(modules)
        finally:
            for name in modules:
                sys.modules.pop(name, None)


def install_in_worker(modules: dict[str, set[str]] | None, outputs: tuple[str, ...] | None) -> None:
    """Install the stand-ins in a worker process for its lifetime; arguments as in `Rasterizers`, None for gsplat."""
    _in_worker.enter_context(cuda_on_cpu())
    sys.modules.update(_modules(None if modules is None else Rasterizers(modules, outputs)))


def _expected(repository: Path, outputs: Sequence[str] | None, rasterizer: str | None) -> Rasterizers:
    """Read which rasterizers a repository imports."""
    found = {"diff_gaussian_rasterization": set[str](), **read_folder(repository).rasterizers}
    modules = {name: names for name, names in found.items() if "." not in name}
    if rasterizer is not None:
        module, _, name = rasterizer.partition(":")
        modules.setdefault(module, set()).add(name)
    return Rasterizers(modules, None if outputs is None else tuple(outputs))


def _modules(expected: Rasterizers | None) -> dict[str, ModuleType]:
    """Make the modules that are imported, by name; for gsplat if no rasterizers are expected."""
    ssim = {"fused_ssim": make_module("fused_ssim", fused_ssim=fused_ssim)}
    if expected is None:
        return ssim
    neighbors = make_module("simple_knn._C", distCUDA2=distCUDA2)
    return {
        **{name: rasterizer_module(name, names, expected.outputs) for name, names in expected.modules.items()},
        "simple_knn": make_module("simple_knn", _C=neighbors),
        "simple_knn._C": neighbors,
        **ssim,
        "gridencoder": make_module("gridencoder", GridEncoder=GridEncoder),
        "shencoder": make_module("shencoder", SHEncoder=SHEncoder),
        "freqencoder": make_module("freqencoder", FreqEncoder=FreqEncoder),
    }


@contextmanager
def _importable(modules: Iterable[str], expected: Rasterizers | None) -> Iterator[None]:
    """Let processes that inherit the search paths import the stand-ins, but not their parent's objects.

    They also find a stand-in for a missing ``nvidia-smi``, with which scripts choose a GPU (Scaffold-GS).
    """
    with TemporaryDirectory(prefix="ca_reg_stand_in_") as folder:
        # The import system returns what is in sys.modules once the file has run.
        arguments = ", ".join(map(repr, expected or (None, None)))
        text = f"from {__name__} import install_in_worker\n\ninstall_in_worker({arguments})\n"
        for name in modules:
            if "." not in name:
                (Path(folder) / f"{name}.py").write_text(text, encoding="utf-8")
        program = Path(folder) / "nvidia-smi"
        program.write_text(NVIDIA_SMI, encoding="utf-8")
        program.chmod(0o755)
        sys.path.append(folder)
        try:
            with patch.dict(os.environ, PATH=os.pathsep.join([os.environ.get("PATH", ""), folder])):
                yield
        finally:
            if folder in sys.path:
                sys.path.remove(folder)
