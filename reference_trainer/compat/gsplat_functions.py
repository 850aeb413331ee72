"""Replacing gsplat's functions by ones that need no CUDA."""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any, NoReturn
from unittest.mock import patch

from torch import Tensor

from reference_trainer.compat.rasterization import make_rasterization
from reference_trainer.model.gaussians import compute_relocation
from reference_trainer.rotations import rotation_matrices

__all__ = ["gsplat_functions", "quat_scale_to_covar_preci"]


@contextmanager
def gsplat_functions() -> Iterator[None]:
    """Let gsplat's rasterization and density control run without CUDA, within a block.

    Replaced, in all modules of gsplat, are ``rasterization``, ``compute_relocation``, ``quat_scale_to_covar_preci`` and
    ``distributed.cli``, which runs its function once. Whatever else gsplat computes on a GPU, such as
    ``rasterization_2dgs``, raises RuntimeError with its name; what gsplat computes in torch is left as it is.

    Raises:
        ImportError: if gsplat is missing.
    """
    with ExitStack() as undo:
        for name, module in {"gsplat.csrc": _no_kernels(), "gsplat.cuda._backend": None}.items():
            undo.callback(_put_module, name, sys.modules.get(name))
            _put_module(name, module)
        try:
            gsplat = importlib.import_module("gsplat")
        except ModuleNotFoundError as error:
            raise ImportError(
                "the stand-in for gsplat's kernels needs the rest of gsplat: pip install gsplat."
            ) from error
        rendering, relocation, distributed = (
            importlib.import_module(f"gsplat.{name}") for name in ("rendering", "relocation", "distributed")
        )
        original = rendering.rasterization
        stand_ins = {
            original: make_rasterization(original, per_axis=_per_axis(gsplat.__version__)),
            rendering.rasterization_2dgs: _refusing(rendering.rasterization_2dgs),
            relocation.compute_relocation: compute_relocation,
            gsplat.quat_scale_to_covar_preci: quat_scale_to_covar_preci,
            distributed.cli: _run_once,
        }
        for name, module in list(sys.modules.items()):
            if name.partition(".")[0] == "gsplat":
                for attribute, value in list(vars(module).items()):
                    if inspect.isfunction(value) and value in stand_ins:
                        undo.enter_context(patch.object(module, attribute, stand_ins[value]))
        yield


def _put_module(name: str, module: ModuleType | None) -> None:
    """Put a module into ``sys.modules``, where gsplat looks for its compiled code; None removes what is there."""
    if module is None:
        sys.modules.pop(name, None)
    else:
        sys.modules[name] = module


def _no_kernels() -> ModuleType:
    """Make a module in place of the missing compiled code."""

    def refuse(name: str) -> NoReturn:
        raise AttributeError(name) if name.startswith("__") else _without_cuda(name)

    module = ModuleType("gsplat.csrc")
    module.__getattr__ = refuse  # type: ignore[method-assign]
    return module


def _refusing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with the same signature that raises, as it needs CUDA."""

    @functools.wraps(function)
    def refuse(*args: Any, **kwargs: Any) -> NoReturn:
        raise _without_cuda(function.__name__)

    return refuse


def _without_cuda(name: str) -> RuntimeError:
    return RuntimeError(
        f"gsplat's {name} needs CUDA, and has no stand-in here. On a CPU gsplat.rasterization runs, and with it the "
        "default and the MCMC strategy."
    )


def _run_once(fn: Callable[..., Any], args: Any, verbose: bool = False) -> bool:
    """Run what ``gsplat.distributed.cli`` runs on every GPU, as on a machine with one."""
    fn(0, 0, 1, args)
    return True


def _per_axis(version: str) -> bool:
    """Whether radii are per axis: since gsplat 1.5."""
    return tuple(int(part) for part in version.split(".")[:2]) >= (1, 5)


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances and their inverses, None for what was not asked for: (N, 3, 3), or if ``triu`` (N, 6).

    The six are xx, xy, xz, yy, yz, zz. Quaternions (N, 4) are wxyz, scales (N, 3) standard deviations.

    Example:
        >>> import torch
        >>> quat_scale_to_covar_preci(torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.0, 2, 3]]), triu=True)[0]
        tensor([[1., 0., 0., 4., 0., 9.]])
    """
    axes = rotation_matrices(quats)

    def product(lengths: Tensor) -> Tensor:
        matrix = (axes * lengths[:, None]) @ (axes * lengths[:, None]).mT
        return matrix.flatten(1)[:, [0, 1, 2, 4, 5, 8]] if triu else matrix

    return product(scales) if compute_covar else None, product(1 / scales) if compute_preci else None
