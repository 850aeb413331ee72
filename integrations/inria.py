"""Code bases derived from the INRIA 3DGS code: one hook on their rasterizer regularizes them, with no edits.

3DGS, DNGaussian, FSGS, CoR-GS, Binocular3DGS, MVGS, AbsGS, DropGaussian and the paper's own code have one thing in
common: they pass activated opacities to ``GaussianRasterizer``, and derive visibility from the radii it returns.
:class:`RasterizerHook` wraps its ``forward``. :func:`render_fn` makes such models scorable, and ``python -m
ca_reg.integrations.run`` hooks a training script without editing it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor, nn

from ca_reg._check import check_count
from ca_reg._random import seeded, split_mix
from ca_reg.chain import WrappedModule
from ca_reg.decay import OpacityDecay
from ca_reg.types import RenderFn, Rendering, read_rendering

from ._calls import (
    CallSite,
    RasterizerCall,
    chain_of,
    hide_dropped,
    second_regularizers,
    white_alpha,
)
from ._patching import PatchedClasses, is_overridden, rendered_once
from ._report import Hook, Skip
from ._steps import Iterations, ModelSteps, Steps, leaves_of

__all__ = ["DEFAULT_MODEL", "RasterizerHook", "Scope", "Steps", "render_fn"]

Scope = Literal["main", "all"]
"""Which training renders of an iteration are regularized, see :class:`RasterizerHook`."""

DEFAULT_MODEL = "scene.gaussian_model:GaussianModel"
_MANY_ZEROS = 1e-3  # share of zero opacities beyond what rounding explains
_ZEROS_EVERY = 127  # renders after which they are counted; odd, as a script may drop in every second one


class RasterizerHook(Hook):
    """Regularize every render of an INRIA-style code base, as a context manager or with install and uninstall.

    Training renders (gradients enabled, opacities and positions trained) get regularized Gaussians, and the radii of
    dropped ones are zeroed on return: visibility, densification and pruning are those of a render without them.
    Renders under ``no_grad`` and for a viewer get the test-time values. All others, such as depth renders with constant
    opacities or detached positions, are left alone; :attr:`tally` counts them by reason.

    The training step, which schedules and masks follow, is told by the ``models``, the parameters (see ``steps``), or
    calls of :meth:`step`. The masks depend on the seed, the model and the step alone, and the global random state is
    untouched: a script picks the same cameras with and without the hook.

    Training without regularization is an error, raised in :meth:`step`, ``update_learning_rate``,
    ``optimizer.step()`` or ``backward()``; see ``patience``.

    Args:
        regularizer: a :class:`~ca_reg.Regularizer`, or several, as :class:`~ca_reg.Chain` takes them; any other module
            must take ``generator=`` in its ``forward``. The hook sets its mode and its step.
        scope: "main" regularizes the first training render of every model and iteration, as the paper's code does, and
            further ones from the same place in the script, its batch (MVGS, 4DGaussians); second views and pseudo
            views, which are rendered elsewhere, are left alone. "all" regularizes all. All share the same mask.
        seed: of the masks and the noise.
        rasterizer: the class to hook, or its name as ``module:Class``; by default those of
            ``diff_gaussian_rasterization`` and ``diff_gaussian_rasterization_abs``, as soon as they are imported.
        candidates: names of classes to hook besides the default, if they turn out to be rasterizers of the family.
        models: names of the Gaussian model classes, as ``module:Class``.
        steps: what marks a new step: "updates", a call of ``update_learning_rate``; "parameters", the first render
            after a change of the positions or opacities.
        viewer: class name of the cameras that a viewer renders with; None if there is no viewer.
        patience: number of optimizer steps of Gaussians in a row without a regularized render, and total number of
            training steps without a render, beyond which an error is raised; 0 for no limit.
        allow_zeros: accept exact zeros among the incoming opacities, by default taken for the code base's own dropout.
        decay: fades the opacities after each step of an optimizer with a parameter group ``opacity``; the group holds
            their logits.

    Raises:
        TypeError: if ``regularizer`` is not a module or takes no ``generator``.
        ValueError: if the regularizer is empty or learns per Gaussian; at a render, if that lacks what it needs.

    Example:
        >>> class GaussianRasterizer(nn.Module):
        ...     def forward(self, means3D, means2D, opacities):
        ...         return opacities.mean().expand(3, 4, 5), torch.full((len(means3D),), 7)
        >>> means, logits = torch.zeros(9, 3, requires_grad=True), torch.zeros(9, 1, requires_grad=True)
        >>> from ca_reg import GaussianDropout
        >>> dropout = GaussianDropout(p=0.5)
        >>> with RasterizerHook(dropout, rasterizer=GaussianRasterizer) as hook:
        ...     hook.step(1)
        ...     image, radii = GaussianRasterizer()(means, None, logits.sigmoid())
        >>> torch.equal(radii > 0, dropout.keep), hook.tally.regularized
        (True, 1)
    """

    def __init__(
        self,
        regularizer: nn.Module,
        *,
        scope: Scope = "main",
        seed: int = 0,
        rasterizer: type | str | None = None,
        candidates: Iterable[str] = (),
        models: Iterable[str] = (DEFAULT_MODEL,),
        steps: Steps = "updates",
        viewer: str | None = "MiniCam",
        patience: int = 100,
        allow_zeros: bool = False,
        decay: OpacityDecay | None = None,
    ) -> None:
        super().__init__(patience, decay)
        for name, value, choices in (("scope", scope, get_args(Scope)), ("steps", steps, get_args(Steps))):
            if value not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}.")
        self._chain = chain_of(regularizer)
        members = list(self._chain)
        if not members:
            raise ValueError("regularizer is empty; without one there is nothing to install.")
        for member in members:
            if isinstance(member, WrappedModule):
                member.check_generator()
        check_count(seed, "seed", minimum=0)
        self._trained = members[0] if len(members) == 1 else self._chain  # the same draws with a layer less
        self._parts = tuple(self._chain.modules())
        self._names = second_regularizers(self._chain)
        self._counts_zeros = self._chain.drops and not allow_zeros
        self._scope = scope
        self._seed = int(seed)
        self._viewer = viewer
        self._iterations = Iterations(steps, self.note_lost)
        self._patched = PatchedClasses(
            rasterizer,
            candidates,
            models,
            rasterize=self._rasterize,
            update=self._iterations.update,
            check=functools.partial(RasterizerCall.check, self._chain),
        )
        self._zeros: tuple[Tensor, torch.cuda.Event | None] | None = None  # share of zero opacities, on its way
        self._generators: dict[tuple[int, torch.device], tuple[torch.Generator, int]] = {}
        self._latest: Tensor | None = None  # opacities of the last regularized render
        self._counted = 0  # renders so far that may have been counted

    def install(self) -> Self:
        """Wrap the rasterizers, now or once they are imported; return the hook.

        Raises an ImportError if no rasterizer is installed and none was given, a RuntimeError if this hook or another
        one is installed already, a TypeError if the rasterizer is not of the INRIA family, and a ValueError if it does
        not take what the regularizer needs.
        """
        if self._handle is not None:
            raise RuntimeError("this hook is installed already; uninstall it first.")
        try:
            self._patched.start()
        except BaseException:
            self._patched.stop()
            raise
        self._count_steps()
        return self

    def uninstall(self) -> None:
        """Restore the classes exactly.

        Raises a RuntimeError if it is not installed, or the classes were wrapped again since; nothing changes then.
        """
        if self._handle is None:
            raise RuntimeError("this hook is not installed.")
        self._patched.check_removable()
        self._stop_counting()
        self._patched.stop()

    def step(self, step: int) -> None:
        """Begin a training step, counted from 1; from then on ``update_learning_rate`` is ignored."""
        check_count(step, "step", minimum=0)
        self._iterations.step(int(step))

    def problem(self) -> str | None:
        """Describe a failure to regularize and its remedy, as every hook does, or a second dropout; else None."""
        return self._double_dropout(wait=True) or super().problem()

    def _explain(self) -> str:
        hooked = " and ".join(self._patched.names) or "nothing, because no known rasterizer was imported"
        return (
            f"Hooked is {hooked}; so far: {'; '.join(self.tally.lines())}. If the training renders with another class, "
            "pass it as rasterizer=... to RasterizerHook (--rasterizer module:Class); if the rates are 0 for longer "
            "than the training, let the schedule begin earlier (--start); if steps without a regularized render are "
            "meant, raise patience (--patience; 0 for any number). Without --dropout and --noise the script runs plain."
        )

    def _rasterize(self, call: RasterizerCall) -> Any:
        """Classify a call of the rasterizer, and make it accordingly."""
        if is_overridden():
            return self._leave(call, Skip.SCORE)
        means, opacities = call.arguments["means3D"], call.arguments["opacities"]
        site = CallSite.find()
        model = site.find_instance(self._patched.models)
        if not torch.is_grad_enabled() or site.is_viewer(self._viewer):
            site.refuse_a_second_regularizer(self._names)
            return self._evaluate(call, self._iterations.evaluation_step(means if model is None else model))
        if not opacities.requires_grad:
            return self._leave(call, Skip.CONSTANT_OPACITY)
        if not means.requires_grad:
            return self._leave(call, Skip.DETACHED_MEANS)
        parameters = [x for x in (means if means.is_leaf else None, next(leaves_of(opacities), None)) if x is not None]
        # Without a model, a parameter takes its place; without either, all calls belong to one model.
        steps = self._iterations.steps_of(model if model is not None else parameters[0] if parameters else self)
        if not steps.count_render(parameters, site.place) and self._scope == "main":
            return self._leave(call, Skip.FURTHER_VIEW)
        site.refuse_a_second_regularizer(self._names)
        del site  # holds the variables of the caller
        if self._counts_zeros:
            self._count_zeros(opacities)
        return self._train(call, steps)

    def _leave(self, call: RasterizerCall, reason: Skip) -> Any:
        self.tally.skipped[reason] += 1
        return call()

    def _evaluate(self, call: RasterizerCall, step: int) -> Any:
        """Make a call with the test-time values."""
        call.evaluate(self._chain, step, self.tally)
        opacities: Tensor = call.arguments["opacities"]
        if torch.is_grad_enabled() and opacities.requires_grad:
            call.arguments["opacities"] = opacities = opacities.view_as(opacities)
            opacities.register_hook(self._refuse_to_train_on_a_viewer)  # type: ignore[no-untyped-call]
        return call()

    def _train(self, call: RasterizerCall, steps: ModelSteps) -> Any:
        """Make a call with regularized Gaussians, and hide the dropped ones from densification."""
        step = steps.training_step
        # The same seed for every render of an iteration, so that all drop the same Gaussians.
        generator = self._generator(steps.index, step, call.arguments["opacities"].device)
        if False in [part.training for part in self._parts]:
            self._chain.train()
        # The chain checks the first opacities, even if its member was called before.
        regularizer = self._trained if self.tally.regularized else self._chain
        regularizer.set_step(step)
        opacities = call.arguments["opacities"]
        keep = call.train(regularizer, step, self.tally, generator)
        self.note_regularized(opacities, step)
        returned = call()
        return returned if keep is None else hide_dropped(returned, keep)

    def _generator(self, model: int, step: int, device: torch.device) -> torch.Generator:
        """Return the source of the draws of a model's step."""
        key = model, device
        if key not in self._generators:
            self._generators[key] = torch.Generator(device), seeded(self._seed, model).initial_seed()
        generator, seed = self._generators[key]
        # numpy's seed sequences take twenty times as long.
        return generator.manual_seed(split_mix(seed, step) >> 1)

    def _count_zeros(self, opacities: Tensor) -> None:
        """Count Gaussians that arrive dropped, in the renders 1, 2, 4, 8, ..., every 127th, and the last one.

        Activated opacities are above 0. A dropout of the code base's own may begin late and with a small rate
        (DropGaussian), so the first renders are not enough. No step waits for a card: the next count reads this one.
        """
        self._latest = opacities.detach()
        self._counted += 1
        if self._counted & (self._counted - 1) and self._counted % _ZEROS_EVERY:
            return
        problem = self._double_dropout()
        if self._zeros is None:
            arrived = torch.cuda.Event() if opacities.is_cuda else None  # type: ignore[no-untyped-call]
            self._zeros = (self._latest == 0).float().mean().to("cpu", non_blocking=True), arrived
            if arrived is not None:
                arrived.record(torch.cuda.current_stream(opacities.device))
        if problem := problem or (self._double_dropout() if opacities.device.type == "cpu" else None):
            raise RuntimeError(problem)

    def _double_dropout(self, *, wait: bool = False) -> str | None:
        """Describe a dropout of the code base's own, if too many opacities were 0 when last counted; else None."""
        share = 0.0
        counted, arrived = self._zeros or (None, None)
        if counted is not None and (arrived is None or arrived.query()):  # type: ignore[no-untyped-call]
            share, self._zeros = float(counted), None
        if wait and self._latest is not None:
            share = max(share, float((self._latest == 0).float().mean()))
        if not share > _MANY_ZEROS:  # of no Gaussians it is nan
            return None
        return (
            f"Gaussians would be dropped twice: {share:.2%} of the opacities of a training render are 0 already, which "
            "is a dropout of the code base's own (DropGaussian has one that cannot be switched off). Switch it off, or "
            "leave out GaussianDropout (--dropout) here. If these zeros are something else: allow_zeros=True, in the "
            "launcher --allow-zeros."
        )

    def _refuse_to_train_on_a_viewer(self, gradient: Tensor) -> None:
        """Raise: a gradient arrived from a render taken for a viewer's."""
        raise RuntimeError(
            f"a training step used a render that was taken for a viewer's, because its camera is a {self._viewer}: its "
            "opacities were scaled, not regularized. If the training cameras are of this class, say that there is no "
            "viewer: viewer=None, in the launcher --viewer none."
        )


def render_fn(
    render: Callable[..., Any], gaussians: Any, pipe: Any, background: Tensor, *, rasterizer: type | None = None
) -> RenderFn:
    """Turn the ``render`` of an INRIA-style code base into a render callable for :class:`ca_reg.CAScore`.

    The opacities are replaced on their way into the rasterizer, so neither the model nor ``render`` is modified, and a
    :class:`RasterizerHook` leaves these renders alone. The image is the one that ``render`` returns, and so is the
    alpha if it has a name there (the paper's code, Binocular3DGS, CoR-GS, DNGaussian). Otherwise a second pass with the
    same opacities measures it, white on black: a depth is never mistaken for an alpha.

    ``render(view, gaussians, pipe, background)`` is the code base's, the other arguments are what it takes: model,
    pipeline settings, a color (3,). ``rasterizer`` is the class that it uses, by default the installed ones. A call
    ``(opacity, view)`` returns a :class:`~ca_reg.types.Rendering`.

    Raises:
        ImportError: when called, if no rasterizer is installed and none was given.
        RuntimeError: when called, if ``render`` does not call the rasterizer exactly once.
        ValueError: when called, if ``render`` does not rasterize as many Gaussians as there are opacities, or returns
            no alpha and the rasterizer takes no ``colors_precomp``.

    Example:
        >>> from ca_reg import CAScore
        >>> class GaussianRasterizer(torch.nn.Module):
        ...     def forward(self, means3D, means2D, opacities):
        ...         return opacities.mean().expand(3, 4, 5), torch.ones(len(means3D), dtype=torch.int32)
        >>> def render(view, gaussians, pipe, background):
        ...     image, radii = GaussianRasterizer()(gaussians, None, torch.full((9, 1), 0.5))
        ...     return {"render": image, "alpha": image[:1]}
        >>> fn = render_fn(render, torch.zeros(9, 3), None, torch.zeros(3), rasterizer=GaussianRasterizer)
        >>> fn(torch.full((9, 1), 0.9), "a view").alpha.mean().item()
        0.899...
        >>> result = CAScore(fn, threshold=0.0)(torch.full((9, 1), 0.9), "a view")
    """

    def overridden(opacity: Tensor, view: Any) -> Rendering:
        with rendered_once(lambda: render(view, gaussians, pipe, background), opacity, rasterizer) as (returned, call):
            image, alpha = read_rendering(returned)
            return Rendering(image, white_alpha(call) if alpha is None else alpha)

    return overridden
