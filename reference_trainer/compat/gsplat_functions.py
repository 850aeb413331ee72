"""Put functions that need no CUDA in the place of gsplat's."""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NoReturn
from unittest.mock import patch

from reference_trainer.compat.rasterization import make_rasterization
from reference_trainer.compat.relocation import compute_relocation, quat_scale_to_covar_preci

__all__ = ["gsplat_functions"]


@contextmanager
def gsplat_functions() -> Iterator[None]:
    """Let gsplat's rasterization and density control run without CUDA, within a block.

    Replaced, in all modules of gsplat, are ``rasterization``, ``compute_relocation``, ``quat_scale_to_covar_preci`` and
    ``distributed.cli``, which runs its function once. Whatever else gsplat computes on a GPU, such as
    ``rasterization_2dgs``, raises RuntimeError with its name; what gsplat computes in torch is left as it is.

    Raises:
        ImportError: if gsplat is missing.
    """
    try:
        gsplat = importlib.import_module("gsplat")
    except ModuleNotFoundError as error:
        raise ImportError("the stand-in for gsplat's kernels needs the rest of gsplat: pip install gsplat.") from error
    rendering = importlib.import_module("gsplat.rendering")
    distributed = importlib.import_module("gsplat.distributed")
    original = rendering.rasterization
    stand_ins = {
        original: make_rasterization(original, per_axis=_per_axis(gsplat.__version__)),
        rendering.rasterization_2dgs: _refusing(rendering.rasterization_2dgs),
        importlib.import_module("gsplat.relocation").compute_relocation: compute_relocation,
        gsplat.quat_scale_to_covar_preci: quat_scale_to_covar_preci,
        distributed.cli: _run_once,
    }
    with ExitStack() as undo:
        # What gsplat finds in the place of its compiled code, when it first looks for it.
        undo.enter_context(patch.object(gsplat, "csrc", _NoKernels(), create=True))
        sys.modules.pop("gsplat.cuda._backend", None)
        undo.callback(sys.modules.pop, "gsplat.cuda._backend", None)
        for name, module in list(sys.modules.items()):
            if name.partition(".")[0] == "gsplat":
                for attribute, value in list(vars(module).items()):
                    if inspect.isfunction(value) and value in stand_ins:
                        undo.enter_context(patch.object(module, attribute, stand_ins[value]))
        yield


class _NoKernels:
    """Compiled code that is not there."""

    def __getattr__(self, name: str) -> NoReturn:
        raise _without_cuda(name)


def _refusing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with the same signature that says that it needs CUDA."""

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
    """Whether radii are by axis: since gsplat 1.5."""
    return tuple(int(part) for part in version.split(".")[:2]) >= (1, 5)
