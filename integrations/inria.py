"""Regularize the code bases that grew out of the INRIA 3DGS code: one hook on their rasterizer, no edits.

3DGS, DNGaussian, FSGS, CoR-GS, Binocular3DGS, MVGS, AbsGS, DropGaussian and the paper's own code have one thing in
common: they hand activated opacities to ``GaussianRasterizer``, and take what was seen from the radii that come back.
:class:`RasterizerHook` wraps its ``forward``. :func:`ca_reg.integrations.inria_score.render_fn` scores such models, and
``python -m ca_reg.integrations.run`` hooks a training script without touching it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import ModuleType, TracebackType
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from ca_reg._regularizer import Regularizer
from ca_reg.modules import GaussianDropout, OpacityNoise

from ._after_import import AfterImport
from ._caller import calling_render, find_instance, is_viewer, own_dropout, own_noise
from ._iterations import Field, Iterations
from ._override import is_overridden
from ._patch import ClassPatch
from ._rasterizer import (
    MODULES,
    ForwardCall,
    check_installed,
    find_radii,
    forward_signature,
    rasterizer_class,
)
from ._tally import Skip, Tally

__all__ = ["RasterizerHook", "Scope"]

Scope = Literal["main", "all"]
"""Which training renders of an iteration are regularized: the first of every model, or all with one mask."""

_MODEL_MODULE = "scene.gaussian_model"


class RasterizerHook:
    """Regularize every render of an INRIA-style code base, as a context manager or with install and uninstall.

    Training renders (gradients on, opacities and positions trained) get regularized opacities, and the radii of dropped
    Gaussians are zeroed on the way out: visibility, densification and pruning are those of a render without them.
    Renders under ``no_grad`` and those for a viewer get the test-time opacities. All others are left alone, such as
    depth renders with constant opacities or detached positions; :attr:`tally` counts them with the reason.

    The training step, which schedules and masks follow, is read off ``GaussianModel.update_learning_rate`` in
    ``scene.gaussian_model``; a code base without it says it with :meth:`step`. The masks depend on the seed, the model
    and the step alone, and the global random numbers are untouched: with and without the hook a script picks the same
    cameras.

    Args:
        regularizer: a ``ca_reg`` regularizer or an ``nn.Sequential`` of them. The hook sets its mode and its step.
        scope: "main" regularizes the first training render of every model and iteration, as the paper's code does, and
            leaves second views and pseudo views alone; "all" regularizes all with one mask, for code bases with several
            views in an iteration (MVGS).
        seed: of the masks and the noise.
        rasterizer: the class to hook; by default those of ``diff_gaussian_rasterization`` and
            ``diff_gaussian_rasterization_abs``, as soon as they are imported.

    Attributes:
        tally: what was done so far.

    Raises:
        TypeError: if ``regularizer`` holds anything but regularizers.
        ValueError: if ``scope`` is unknown, or there is no regularizer.

    Example:
        >>> class GaussianRasterizer(nn.Module):
        ...     def forward(self, means3D, means2D, opacities):
        ...         return opacities.mean().expand(3, 4, 5), torch.full((len(means3D),), 7)
        >>> means, logits = torch.zeros(9, 3, requires_grad=True), torch.zeros(9, 1, requires_grad=True)
        >>> dropout = GaussianDropout(p=0.5)
        >>> with RasterizerHook(dropout, rasterizer=GaussianRasterizer) as hook:
        ...     hook.step(1)
        ...     image, radii = GaussianRasterizer()(means, None, logits.sigmoid())
        >>> torch.equal(radii > 0, dropout.keep), hook.tally.regularized
        (True, 1)
    """

    def __init__(
        self, regularizer: nn.Module, *, scope: Scope = "main", seed: int = 0, rasterizer: type | None = None
    ) -> None:
        if scope not in get_args(Scope):
            raise ValueError(f"scope must be one of {', '.join(get_args(Scope))}, got {scope!r}.")
        self._chain = _regularizers(regularizer)
        if not self._chain:
            raise ValueError("regularizer is empty; without one there is nothing to install.")
        self._scope = scope
        self._seed = int(seed)
        self._rasterizer = rasterizer
        self._iterations = Iterations()
        self._models: tuple[type, ...] = ()
        self._patches: list[ClassPatch] = []
        self._watch: AfterImport | None = None
        self.tally = Tally()

    def install(self) -> RasterizerHook:
        """Wrap the rasterizers, those that are imported and those that will be; return the hook.

        Raises:
            ImportError: if no rasterizer is installed and none was given.
            RuntimeError: if this hook or another one is in force already.
            TypeError: if the rasterizer is not one of the INRIA family.
        """
        if self._watch is not None:
            raise RuntimeError("this hook is installed already; uninstall it first.")
        if self._rasterizer is None:
            check_installed()
        watch = AfterImport({_MODEL_MODULE: self._found_model, **dict.fromkeys(MODULES, self._found_rasterizer)})
        self._watch = watch
        try:
            if self._rasterizer is not None:
                self._wrap(self._rasterizer)
            watch.start()
        except BaseException:
            self.uninstall()
            raise
        return self

    def uninstall(self) -> None:
        """Put the classes back exactly as they were.

        Raises:
            RuntimeError: if the hook is not installed, or someone wrapped the classes again since; nothing is then
                changed.
        """
        if self._watch is None:
            raise RuntimeError("this hook is not installed.")
        for patch in self._patches:
            patch.check_removable()
        self._watch.stop()
        self._watch = None
        while self._patches:
            self._patches.pop().remove()

    def __enter__(self) -> RasterizerHook:
        """Install the hook."""
        return self.install()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Uninstall the hook."""
        self.uninstall()

    def step(self, step: int) -> None:
        """Say which training step begins, counted from 1; ``update_learning_rate`` is no longer looked at."""
        self._iterations.step(step)

    def _found_rasterizer(self, module: ModuleType) -> None:
        """Wrap the rasterizer of a module that was imported, unless another class was asked for."""
        found = rasterizer_class(module)
        if found is not None and self._rasterizer is None and all(patch.owner is not found for patch in self._patches):
            self._wrap(found)

    def _found_model(self, module: ModuleType) -> None:
        """Listen to the learning rate updates of the models of a code base."""
        model = getattr(module, "GaussianModel", None)
        if not isinstance(model, type) or not hasattr(model, "update_learning_rate"):
            return

        def make(update: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(update)
            def update_learning_rate(model: Any, iteration: int, *args: Any, **kwargs: Any) -> Any:
                self._iterations.update(model, int(iteration))
                return update(model, iteration, *args, **kwargs)

            return update_learning_rate

        self._models += (model,)
        self._patches.append(ClassPatch(model, "update_learning_rate", make))

    def _wrap(self, rasterizer: type) -> None:
        """Wrap the forward of a rasterizer."""
        signature = forward_signature(rasterizer)
        function: Any = rasterizer.forward  # type: ignore[attr-defined]
        while function is not None:
            if isinstance(vars(function).get("ca_reg_hook"), RasterizerHook):
                raise RuntimeError(
                    f"{rasterizer.__qualname__} has a RasterizerHook already; Gaussians would be dropped twice. "
                    "Uninstall that one first, or put both regularizers into one nn.Sequential."
                )
            function = getattr(function, "__wrapped__", None)

        def make(forward: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(forward)
            def regularized_forward(*args: Any, **kwargs: Any) -> Any:
                return self._rasterize(ForwardCall(forward, signature.bind(*args, **kwargs)))

            vars(regularized_forward)["ca_reg_hook"] = self
            return regularized_forward

        self._patches.append(ClassPatch(rasterizer, "forward", make))

    def _rasterize(self, call: ForwardCall) -> Any:
        """Decide what a call of the rasterizer is for, and make it."""
        if is_overridden():
            return self._leave(call, Skip.SCORE)
        means, opacities = call.arguments["means3D"], call.arguments["opacities"]
        render = calling_render()
        # Without a model and with computed positions (a deformed field) all calls belong to one field: this hook's.
        model = find_instance(render, self._models)
        owner = model if model is not None else means if means.is_leaf else self
        field = self._iterations.field(owner)
        if not torch.is_grad_enabled() or is_viewer(render):
            self._refuse_a_second_regularizer(render)
            return self._evaluate(call, field)
        if not opacities.requires_grad:
            return self._leave(call, Skip.CONSTANT_OPACITY)
        if not means.requires_grad:
            return self._leave(call, Skip.DETACHED_MEANS)
        field.count_render(means)
        if self._scope == "main" and field.renders > 1:
            return self._leave(call, Skip.FURTHER_VIEW)
        self._refuse_a_second_regularizer(render)
        return self._train(call, field)

    def _leave(self, call: ForwardCall, reason: Skip) -> Any:
        """Make a call as it is."""
        self.tally.skipped[reason] += 1
        return call()

    def _evaluate(self, call: ForwardCall, field: Field) -> Any:
        """Make a call with the test-time opacities."""
        given = opacities = call.arguments["opacities"]
        for module in self._chain:
            module.eval().set_step(field.evaluation_step)
            opacities = module(opacities)
        if opacities is given:
            return self._leave(call, Skip.NOTHING_TO_SCALE)
        self.tally.scaled += 1
        call.arguments["opacities"] = opacities
        return call()

    def _train(self, call: ForwardCall, field: Field) -> Any:
        """Make a call with regularized opacities, and hide the dropped Gaussians from densification."""
        given = opacities = call.arguments["opacities"]
        # The same for every render of an iteration, so that all of them drop the same Gaussians.
        entropy = np.random.SeedSequence([self._seed, field.index, field.training_step]).generate_state(1, np.uint64)
        generator = torch.Generator(given.device).manual_seed(int(entropy[0] >> np.uint64(1)))
        for module in self._chain:
            module.train().set_step(field.training_step)
            opacities = module(opacities, generator=generator)
        if opacities is given:
            return self._leave(call, Skip.RATE_ZERO)
        self.tally.count_regularized(field.training_step)
        call.arguments["opacities"] = opacities
        returned = call()
        dropouts = [module for module in self._chain if isinstance(module, GaussianDropout)]
        if all(module.keep is None for module in dropouts):
            return returned
        position = find_radii(returned, given.shape[0])
        radii: Tensor = returned[position]
        for module in dropouts:
            radii = module.mask_radii(radii)
        return (*returned[:position], radii, *returned[position + 1 :])

    def _refuse_a_second_regularizer(self, render: Any) -> None:
        """Raise if the calling render regularizes as well, so that everything would be done twice."""
        for kind, own in ((GaussianDropout, own_dropout(render)), (OpacityNoise, own_noise(render))):
            if own is not None and any(isinstance(module, kind) for module in self._chain):
                raise RuntimeError(f"{kind.__name__} would be applied twice: the calling render has {own}.")


def _regularizers(module: nn.Module) -> list[Regularizer]:
    """Return the regularizers of a chain in order."""
    if isinstance(module, Regularizer):
        return [module]
    if isinstance(module, nn.Sequential):
        return [regularizer for child in module for regularizer in _regularizers(child)]
    raise TypeError(
        f"regularizer must be GaussianDropout, OpacityNoise or an nn.Sequential of them, got {type(module).__name__}."
    )
