"""Regularizers for every code base that calls ``gsplat.rasterization``.

In your own script, one line wraps the function:

    rasterization = regularized(gsplat.rasterization, GaussianDropout(0.2))

For scripts that are not to be edited, :func:`install` replaces it before the script is loaded. To score a gsplat model,
see :mod:`ca_reg.integrations.gsplat_model`.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import itertools
import re
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any, ClassVar, Self
from unittest.mock import patch

import torch
from torch import Tensor, nn

from ca_reg._random import seeded
from ca_reg.decay import OpacityDecay

from ._calls import Call, CallSite, Signature, chain_of
from ._report import Hook, Skip, Tally
from ._steps import FINISHED, leaves_of

__all__ = [
    "Installation", "Rasterization", "Regularized", "install", "load_gsplat", "regularized", "unregularized_calls",
    "version_numbers",
]  # fmt: skip

Rasterization = Callable[..., tuple[Any, ...]]
"""``gsplat.rasterization``, or a function with its arguments that returns its ``info`` last."""

_HOLDERS = ("gsplat", "gsplat.rendering")  # the public modules that scripts import the functions from
_PLAIN = ContextVar("_PLAIN", default=False)  # of a thread: another one may train meanwhile
_EVIDENCE = 10.0  # dropped Gaussians expected in a list; that none is there by chance has probability e^-10


def regularized(
    rasterization: Rasterization, regularizer: nn.Module, *, generator: torch.Generator | None = None
) -> Regularized:
    """Wrap ``gsplat.rasterization`` so that the Gaussians pass through a regularizer.

    A call trains if the regularizer is in ``train()``, gradients are enabled, and the opacities require grad; any other
    call evaluates, whatever the mode of the module: test views under ``no_grad`` get the scaled opacities of ``eval()``
    without changes to the script. Evaluation does not modify the module, so another thread may train with it. All
    cameras of a call share one draw, made for the view matrix of the first. A schedule needs ``set_step``, as always.

    Dropped Gaussians leave no trace in density control: their ``info["radii"]`` are 0, in the shapes of gsplat 1.4
    ([C, N]) and later ([C, N, 2]). In packed mode gsplat 1.5 and newer does not list them.

    Convention: activated opacities, [..., N]; several batches are rendered as one set of Gaussians.

    Args:
        rasterization: ``gsplat.rasterization`` or ``gsplat.rasterization_2dgs``, or a function with the same arguments.
        regularizer: a :class:`~ca_reg.Regularizer` or any other module, or several, as :class:`~ca_reg.Chain` takes
            them. Spherical harmonics are ``colors`` passed with ``sh_degree``.
        generator: source of the draws, passed to every member.

    Raises:
        ValueError: if ``rasterization`` is regularized already, or the regularizer learns per Gaussian or needs what no
            call can supply; at a call, if that lacks what the regularizer needs.
        RuntimeError: at a call in training that drops Gaussians, if there are no radii to zero: in packed mode where
            gsplat lists Gaussians of opacity 0 (before 1.5, and 2DGS), or where ``info`` has none.

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


class _GsplatCall(Call):
    """A call of ``gsplat.rasterization``."""

    names: ClassVar = {"quaternions": "quats", "sh": "colors"}
    instead = "covars take the place of scales and quats, colors without sh_degree or for each camera that of sh"

    def get(self, field: str) -> Tensor | None:
        """Return a field; the view matrix is that of the first camera."""
        if field == "view_matrix":
            matrices: Tensor = self.arguments["viewmats"]
            return matrices.reshape(-1, 4, 4)[0]
        if field == "sh":
            hidden = self.arguments.get("sh_degree") is None
        else:
            hidden = field != "means" and self.arguments.get("covars") is not None
        return None if hidden else super().get(field)


class Regularized:
    """A ``rasterization`` whose Gaussians pass through a ``regularizer``; made by :func:`regularized`.

    ``chain`` is the regularizer as a :class:`~ca_reg.Chain`. ``tally`` counts what was done; in an
    :class:`Installation`, by all its functions.
    """

    _eager: Any = None

    def __init__(
        self, rasterization: Rasterization, regularizer: nn.Module, generator: torch.Generator | None = None,
        *, hook: Installation | None = None,
    ) -> None:  # fmt: skip
        if isinstance(rasterization, Regularized):
            raise ValueError(
                "this rasterization is regularized already, and opacities would be dropped twice: compose regularizers "
                "with Chain, or take its .rasterization."
            )
        self.chain = chain_of(regularizer)
        signature = inspect.signature(rasterization)
        if "opacities" not in signature.parameters:
            raise TypeError(f"expected gsplat.rasterization, got {rasterization!r}, which has no argument opacities.")
        _GsplatCall.check(self.chain, signature)
        self._signature = Signature(signature)
        self.rasterization = rasterization
        self.regularizer = regularizer
        self.tally = Tally() if hook is None else hook.tally
        self._generator = generator
        self._hook = hook
        self._missed = 0.0  # dropped Gaussians that a packed list could have held, and did not
        # Graph break in compiled callers. On the class, so that instances can be pickled; here, as it imports dynamo.
        if Regularized._eager is None:
            Regularized._eager = torch.compiler.disable(Regularized._rasterize)  # type: ignore[no-untyped-call]
        functools.update_wrapper(self, rasterization)

    def __call__(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Rasterize with regularized Gaussians; takes and returns what ``rasterization`` does."""
        out: tuple[Any, ...] = self._eager(args, kwargs, trains=self.regularizer.training)
        return out

    def evaluate(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Rasterize with the test-time values, whatever the mode."""
        out: tuple[Any, ...] = self._eager(args, kwargs, trains=False)
        return out

    def _rasterize(self, args: tuple[Any, ...], kwargs: dict[str, Any], *, trains: bool) -> tuple[Any, ...]:
        """Rasterize in training mode if ``trains`` and gradients reach the opacities, else in evaluation mode."""
        if _PLAIN.get():
            return self.rasterization(*args, **kwargs)
        call = _GsplatCall(self.rasterization, self._signature, args, kwargs)
        opacities: Tensor = call.arguments["opacities"]
        trains = trains and torch.is_grad_enabled() and opacities.requires_grad
        if trains and self._hook is not None:
            trains = not _of_a_model_in_evaluation(opacities)
        keep = None
        if not trains:
            # What only evaluates in this process was trained before: past the end of every schedule.
            trained = self._hook is None or self.tally.regularized or self.tally.skipped[Skip.RATE_ZERO]
            call.evaluate(self.chain, self.chain.step if trained else FINISHED, self.tally)
        else:
            if self._hook is not None:
                self.chain.set_step(next(self._hook.steps))
            generator = self._generator if self._hook is None else self._hook.generator(opacities.device)
            keep = call.train(self.chain, self.chain.step, self.tally, generator)
            if self._hook is not None:
                self._hook.note_regularized(opacities)
        *images, info = call()
        if keep is not None:  # on several GPUs, too: info holds this rank's Gaussians, in the cameras of all ranks
            self._hide_dropped(info, keep.view_as(opacities))
        return (*images, info)

    def _hide_dropped(self, info: MutableMapping[str, Any], keep: Tensor) -> None:
        """Zero the radii of dropped Gaussians; ``keep`` is [..., N]."""
        if "radii" not in info:
            raise RuntimeError(
                f"{getattr(self.rasterization, '__name__', self.rasterization)} returns no radii, so that "
                "dropped Gaussians cannot be hidden from density control: train with gsplat.rasterization or "
                "gsplat.rasterization_2dgs."
            )
        gaussians, radii = info.get("gaussian_ids"), info["radii"]
        if gaussians is None:
            per_camera = keep.unsqueeze(-2)  # [..., 1, N]
            info["radii"] = radii * (per_camera if radii.ndim == per_camera.ndim else per_camera.unsqueeze(-1))
        elif self._missed < _EVIDENCE and keep.numel():
            # Whether they are listed depends on gsplat's version alone. The check synchronizes a GPU, so it ends once
            # enough Gaussians were dropped for some to have been listed; a draw that drops none tells nothing.
            batches = info.get("batch_ids")
            listed = (gaussians if batches is None else batches * keep.shape[-1] + gaussians).long()
            kept, share = int(keep.reshape(-1)[listed].sum()), float(keep.float().mean())
            if kept < len(listed):
                raise RuntimeError(
                    "this rasterization lists Gaussians of opacity 0 in packed mode, as gsplat before 1.5 and "
                    "rasterization_2dgs do, and density control would count them as seen: pass packed=False, or, for "
                    "gsplat.rasterization, install gsplat>=1.5."
                )
            self._missed += kept * (1 - share) / max(share, 1e-6)


def _of_a_model_in_evaluation(opacities: Tensor) -> bool:
    """Whether the caller is a model in ``eval()`` whose own these are: nerfstudio evaluates losses with gradients."""
    caller = CallSite.find().variables.get("self")
    if not isinstance(caller, nn.Module) or caller.training:
        return False
    own = {id(x) for x in caller.parameters()}
    return any(id(x) in own for x in leaves_of(opacities))


class Installation(Hook):
    """The replacements that :func:`install` made; undone by :meth:`uninstall` or at the end of a ``with`` block.

    ``functions`` are all of them by name, ``tally`` counts what they did.
    """

    rasterization: Regularized
    """The replacement of ``gsplat.rasterization``."""

    def __init__(
        self, regularizer: nn.Module, *, generator: torch.Generator | None = None, seed: int | None = None,
        patience: int = 100, decay: OpacityDecay | None = None,
    ) -> None:  # fmt: skip
        super().__init__(patience, decay)
        self.functions: dict[str, Regularized] = {}
        self.steps = itertools.count()
        self._regularizer, self._generator, self._seed = regularizer, generator, seed
        self._undo = ExitStack()

    def install(self) -> Self:
        """Replace the functions, as :func:`install`."""
        load_gsplat()
        found = {
            (holder, name): function
            for holder in map(importlib.import_module, _HOLDERS)
            for name, function in vars(holder).items()
            if name.startswith("rasterization")
            and callable(function)
            and "opacities" in inspect.signature(function).parameters
        }
        made = {x: Regularized(x, self._regularizer, self._generator, hook=self) for x in found.values()}
        for (holder, name), function in found.items():
            self.functions[name] = made[function]
            self._undo.enter_context(patch.object(holder, name, made[function]))
        self.rasterization = self.functions["rasterization"]
        self._count_steps()
        return self

    def generator(self, device: torch.device) -> torch.Generator | None:
        """Return the source of the draws, made at the first call: by then it is known which rank this is."""
        if self._generator is None and self._seed is not None:
            distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
            rank = torch.distributed.get_rank() if distributed else 0
            # Each rank trains Gaussians of its own, so it needs masks of its own.
            self._generator = (
                seeded(self._seed, rank, device=device) if rank else torch.Generator(device).manual_seed(self._seed)
            )
        return self._generator

    def uninstall(self) -> None:
        """Restore the original functions; a second call does nothing."""
        self._stop_counting()
        self._undo.close()

    def _explain(self) -> str:
        return (
            f"So far: {'; '.join(self.tally.lines())}. Either the script had imported the functions of gsplat before "
            "install() replaced them, or it renders without them, or its opacities need no gradient, or the "
            "regularizer is in eval(). Install first; else wrap what it calls with regularized(). If the rates are 0 "
            "for longer than the training, let the schedule begin earlier (--start); if steps without regularization "
            "are meant, raise patience."
        )


def install(
    regularizer: nn.Module, *, generator: torch.Generator | None = None, patience: int = 100,
    decay: OpacityDecay | None = None,
) -> Installation:  # fmt: skip
    """Replace gsplat's functions for scripts that are not edited.

    These are the functions named ``rasterization...`` that take opacities, 2DGS included, in ``gsplat`` and in
    ``gsplat.rendering``. Install before the script is imported: modules that have imported a name already keep the old
    function. Such a script does not set the step: the regularizer's step is the number of training calls so far.

    Arguments and errors are those of :func:`regularized`, besides an ImportError if gsplat is missing and a ValueError
    if it is installed already. More than ``patience`` steps in a row, of optimizers with a parameter group ``opacity``
    or ``opacities``, without a regularized call end the training in a RuntimeError; 0 for no limit. After each of these
    steps ``decay`` fades the opacities, whose logits the group holds.

    Example:
        >>> import runpy
        >>> from ca_reg import GaussianDropout
        >>> with install(GaussianDropout(0.2)) as installation:  # doctest: +SKIP
        ...     runpy.run_path("simple_trainer.py", run_name="__main__")
        >>> installation.tally.regularized  # doctest: +SKIP
        30000
    """
    return Installation(regularizer, generator=generator, patience=patience, decay=decay).install()


def load_gsplat(device: torch.device | None = None) -> Any:
    """Return the module ``gsplat``; raise ImportError without one of 1.4 or newer, RuntimeError on another device."""
    if device is not None and device.type != "cuda":
        raise RuntimeError(f"gsplat renders on CUDA devices only, and the Gaussians are on {device}: move them there.")
    try:
        gsplat = importlib.import_module("gsplat")
    except ModuleNotFoundError as error:
        raise ImportError("this needs gsplat: pip install 'ca_reg[gsplat]' (and a CUDA device to run it).") from error
    version = str(getattr(gsplat, "__version__", ""))
    if not hasattr(gsplat, "rasterization") or [] < version_numbers(version) < [1, 4]:
        raise ImportError(
            f"gsplat {version} is too old: 1.4 was the first whose rasterization can be regularized. Install "
            "gsplat>=1.4; a script that was written for an older one may need changes of its own."
        )
    return gsplat


def version_numbers(version: str) -> list[int]:
    """Return the first two numbers of a version, such as [1, 5]."""
    return [int(part) for part in re.findall(r"\d+", version)[:2]]


@contextmanager
def unregularized_calls() -> Iterator[None]:
    """Let regularized functions pass opacities as they are within a block, for scores that choose them themselves."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)
