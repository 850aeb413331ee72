"""Installing the stand-ins for the CUDA extensions that a foreign repository imports, or for gsplat's functions."""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from unittest.mock import patch

from ca_reg.integrations._scripts import Sources, in_children, is_source, read_folder
from reference_trainer.compat.cuda import cuda_on_cpu
from reference_trainer.compat.extensions import (
    FreqEncoder,
    GridEncoder,
    Refusing,
    SHEncoder,
    distCUDA2,
    fused_ssim,
    make_module,
)
from reference_trainer.compat.gsplat import gsplat_functions
from reference_trainer.compat.rasterizer import rasterizer_module

__all__ = ["install_in_child", "stand_in"]

NVIDIA_SMI = """#!/bin/sh
printf 'GPU 00000000:00:00.0\\n    FB Memory Usage\\n'
for line in Total Reserved Used Free; do printf '        %s : 0 MiB\\n' $line; done
"""


@contextmanager
def stand_in(
    repository: str | Path | None = None, outputs: Sequence[str] | None = None, rasterizer: str | None = None
) -> Iterator[tuple[str, ...]]:
    """Let a repository of the INRIA family, or scripts that call gsplat, run without CUDA within a block.

    The extensions of the INRIA family are ``diff_gaussian_rasterization``, the other modules that the repository
    imports a ``...Rasterizer`` from, unless they are its own, ``simple_knn``, ``fused_ssim``, and the encoders
    ``gridencoder``, ``shencoder`` and ``freqencoder``, also within another package. Further compiled code may be
    imported, and raises once it is called. For gsplat its functions are replaced (`gsplat_functions`), and
    ``fused_ssim``, which its trainer imports. "cuda" is mapped to the CPU unless there is a CUDA device. Modules that
    were imported within the block keep the stand-ins. Processes that start within it, such as workers of data loaders
    on macOS, have them as well.

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
    given = (None if repository is None else str(Path(repository).resolve()), outputs, rasterizer)
    with in_children(f"{__name__}:install_in_child", *given), _nvidia_smi(), _installed(*given) as names:
        yield names


def install_in_child(repository: str | None, outputs: Sequence[str] | None, rasterizer: str | None) -> None:
    """Install the stand-ins, with the arguments of `stand_in`, in a process that was started with them."""
    undo = ExitStack()
    undo.enter_context(_installed(repository, outputs, rasterizer))
    atexit.register(undo.close)  # holds them until the end


@contextmanager
def _installed(
    repository: str | None, outputs: Sequence[str] | None, rasterizer: str | None
) -> Iterator[tuple[str, ...]]:
    """Install the stand-ins in this process."""
    modules = {"fused_ssim": make_module("fused_ssim", fused_ssim=fused_ssim)}
    if repository is not None:
        modules = _modules(read_folder(Path(repository)), None if outputs is None else tuple(outputs), rasterizer)
    if present := [name for name in modules if name in sys.modules]:
        raise RuntimeError(
            f"{', '.join(present)} {'is' if len(present) == 1 else 'are'} imported already: start a new process, and "
            "install the stand-in before the repository is imported; or end an earlier one."
        )
    with cuda_on_cpu(), gsplat_functions() if repository is None else nullcontext():
        sys.modules.update(modules)
        try:
            yield tuple(modules)
        finally:
            for name in modules:
                sys.modules.pop(name, None)


def _modules(sources: Sources, outputs: tuple[str, ...] | None, rasterizer: str | None) -> dict[str, ModuleType]:
    """Make the modules that a repository imports, by name."""
    rasterizers = {"diff_gaussian_rasterization": set[str](), **sources.rasterizers}
    if rasterizer is not None:
        module, _, name = rasterizer.partition(":")
        rasterizers.setdefault(module, set()).add(name)
    neighbors = make_module("simple_knn._C", distCUDA2=distCUDA2)
    extensions = {
        "simple_knn": make_module("simple_knn", _C=neighbors),
        "simple_knn._C": neighbors,
        "fused_ssim": make_module("fused_ssim", fused_ssim=fused_ssim),
        "gridencoder": make_module("gridencoder", GridEncoder=GridEncoder),
        "shencoder": make_module("shencoder", SHEncoder=SHEncoder),
        "freqencoder": make_module("freqencoder", FreqEncoder=FreqEncoder),
    }
    modules = {name: rasterizer_module(name, names, outputs) for name, names in rasterizers.items()} | extensions
    for name in sorted(sources.imports - modules.keys()):
        package, compiled, _ = f"{name}.".partition("._C.")
        # Many import more compiled code than they call (hierarchical-3d-gaussians).
        if compiled and "." not in package and package not in modules and find_spec(package) is None:
            inner = make_module(f"{package}._C", __getattr__=Refusing(f"{package}._C").__getattr__)
            modules |= {package: make_module(package, _C=inner), f"{package}._C": inner}
        # Built within a package of the repository, such as gaussian_splatting.simple_knn.
        within = next((module for own, module in extensions.items() if name.endswith(f".{own}")), None)
        if within is not None and not is_source(sources.root, name):
            modules[name] = within
    return modules


@contextmanager
def _nvidia_smi() -> Iterator[None]:
    """Let scripts find a stand-in for a missing ``nvidia-smi``, with which some choose a GPU (Scaffold-GS)."""
    with TemporaryDirectory(prefix="ca_reg_stand_in_") as folder:
        program = Path(folder) / "nvidia-smi"
        program.write_text(NVIDIA_SMI, encoding="utf-8")
        program.chmod(0o755)
        with patch.dict(os.environ, PATH=os.pathsep.join([os.environ.get("PATH", ""), folder])):
            yield
