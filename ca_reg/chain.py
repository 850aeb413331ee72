"""Several regularizers in sequence, as one."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ca_reg.functional import Multiplier
from ca_reg.regularizer import Draw, Learned, Params, Regularizer
from ca_reg.schedules import Scheduled

__all__ = ["Chain", "WrappedModule"]


class Chain(Regularizer):
    """Regularizers applied one after the other; trainers and hooks wrap whatever they are given in a chain.

    Use it in place of ``nn.Sequential``, which has no :attr:`keep`, :meth:`mask_radii` and :meth:`set_step`, and which
    evaluates the mean of the second member at the mean of the first: the members of a chain contribute their joint
    mean, in whatever order. The exception is opacity noise behind other noise or a soft mask, whose clamp depends on
    their draw: there the chain does as ``nn.Sequential``, and has no multiplier. A Gaussian is dropped if any member
    drops it. A module that stands in a chain twice draws twice. Members in ``eval()`` apply their test-time value even
    in training.

    Args:
        members: regularizers; an ``nn.Sequential`` or another chain is flattened, any other module becomes a
            :class:`WrappedModule`, and what is no module raises a TypeError.

    Example:
        >>> from ca_reg import GaussianDropout, OpacityNoise
        >>> chain = Chain(GaussianDropout(0.5), OpacityNoise(0.8))
        >>> opacity = chain(torch.full((9,), 0.6))
        >>> bool((opacity[~chain.keep] == 0).all())
        True
    """

    def __init__(self, *members: nn.Module) -> None:
        super().__init__()
        self.members = nn.ModuleList(part for member in members for part in _flatten(member))

    def __iter__(self) -> Iterator[Regularizer]:
        if torch.compiler.is_compiling():
            return iter(self.members)  # type: ignore[arg-type]
        # The same in a fifth of the time: every step asks several times.
        return iter(self._modules["members"]._modules.values())  # type: ignore[arg-type, union-attr]

    def __len__(self) -> int:
        return len(self.members)

    @property
    def needs(self) -> tuple[str, ...]:  # type: ignore[override]
        """The fields that the members need."""
        return tuple(dict.fromkeys(name for member in self for name in member.needs))

    @property
    def learns(self) -> Mapping[str, Learned]:  # type: ignore[override]
        """What the members learn."""
        return {name: learned for member in self for name, learned in member.learns.items()}

    @property
    def drops(self) -> bool:  # type: ignore[override]
        """Whether a member may drop Gaussians."""
        return any(member.drops for member in self)

    @property
    def step(self) -> int:
        """The training step: the latest that was set on the chain, a member, or a submodule of one."""
        steps: list[int] = [vars(self)["step"]]
        for member in self:
            parts = member.modules() if member._modules else (member,)
            steps += [step for part in parts if isinstance(step := getattr(part, "step", 0), int)]
        return max(steps)

    @step.setter
    def step(self, step: int) -> None:
        vars(self)["step"] = step

    def set_step(self, step: int) -> None:
        """Set the step of every member."""
        super().set_step(step)
        for member in self:
            member.set_step(step)

    def hold(self, step: int) -> None:
        """Keep the rates of all members."""
        for member in self:
            member.hold(step)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # The chain and its members of constant rate save no step. If they stayed at a later one that was set before,
        # the step of the whole, which is the latest of all, would not go back to the saved one.
        scheduled = [name for name, part in self.named_modules() if isinstance(part, Scheduled)]
        saved = [state_dict[key] for name in scheduled if (key := f"{prefix}{name}.step") in state_dict]
        if saved:
            self.set_step(max(round(float(step)) for step in saved))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def regularize(self, x: Params, generator: torch.Generator | None = None) -> Params:
        """Let every member draw in turn, each given the output of the one before."""
        draws: list[Draw | None] = []
        for member in self:
            if member.training:
                x = member.regularize(x, generator)
                draws.append(member.last)  # this thread's
            else:
                if member.renders_mean:
                    member.check_needs(x)
                x = member.expected(x)
                draws.append(None)
        self._remember(_combine_draws(draws))
        return x

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw for every member, whatever its mode."""
        draws = []
        for member in self:
            draws.append(member.draw(x, generator))
            x = member.replay(x, draws[-1])
        return _combine_draws(draws)

    def replay(self, x: Params, draw: Draw) -> Params:
        """Apply the members' draws, and the test-time values of those that were in ``eval()``."""
        for member, own in zip(self, draw.value, strict=True):
            x = member.expected(x) if own is None else member.replay(x, own)
        return x

    def expected(self, x: Params) -> Params:
        """Return the test-time value of all members."""
        means: list[Regularizer] = []
        for member in self:
            if member.renders_mean:
                member.check_needs(x)
                means.append(member)
            elif (out := member.expected(x)) is not x:  # of a foreign module, which meets what those before it render
                x, means = member.expected(_joint_mean(means, x)) if means else out, []
        return _joint_mean(means, x)

    def alpha_factor(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return the product of the multipliers; None if a member has none, or noise stands behind a soft factor."""
        return _alpha_factor(list(self), x)

    def test_alpha_factor(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return the same for a finished model."""
        return _alpha_factor(list(self), x, test=True)


class WrappedModule(Regularizer):
    """Adapter that lets any module on activated opacities (N,) act as a regularizer, called in its own mode.

    It drops the Gaussians where its attribute ``keep``, (N,) bool, is False, or, without that attribute, those whose
    opacity it sets to 0. The step goes to its ``set_step`` and those of its submodules. Test-time values come from a
    copy in ``eval()`` that shares all tensors.

    Args:
        module: called as ``module(opacity)``, or ``module(opacity, generator=...)`` if there is a generator.

    Example:
        >>> WrappedModule(nn.Dropout(0.5)).eval()(torch.full((3,), 0.5))
        tensor([0.5000, 0.5000, 0.5000])
    """

    def __init__(self, module: nn.Module) -> None:
        if not isinstance(module, nn.Module):
            raise TypeError(f"a regularizer must be a torch module, got {type(module).__name__}.")
        super().__init__()
        self.module = module

    def check_generator(self) -> None:
        """Raise a TypeError unless its ``forward`` takes ``generator``, or any keyword argument."""
        parameters = inspect.signature(self.module.forward).parameters
        if "generator" not in parameters and all(x.kind is not x.VAR_KEYWORD for x in parameters.values()):
            raise TypeError(
                f"the forward of {type(self.module).__name__} takes no argument generator, by which hooks and scores "
                "repeat a draw and leave the global random numbers alone. Add generator=None to it, and draw from it."
            )

    def set_step(self, step: int) -> None:
        """Pass the step to the `set_step` of the module and its submodules, where they have one."""
        super().set_step(step)
        _set_step(self.module, step)

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Call the module."""
        before = x.opacities
        if generator is not None:
            self.check_generator()  # before the call, which would end in a TypeError that names no remedy
        after: Tensor = self.module(before) if generator is None else self.module(before, generator=generator)
        if after is before:
            return Draw(after)
        # Its own mask first: where opacities were 0 before, the result does not tell what was dropped.
        if hasattr(self.module, "keep"):
            keep: Any = self.module.keep
            return Draw(after, None if keep is None else keep.reshape(-1))
        return Draw(after, ((after.detach() != 0) | (before.detach() == 0)).reshape(-1))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Return the opacities that the module returned."""
        return x if draw.value is x.opacities else x._replace(opacities=draw.value)

    def expected(self, x: Params) -> Params:
        """Call a copy of the module in ``eval()``."""
        twin = _evaluating(self.module)
        if x.step is not None:
            _set_step(twin, x.step)
        opacities: Tensor = twin(x.opacities)
        return x if opacities is x.opacities else x._replace(opacities=opacities)


def _flatten(module: nn.Module) -> list[Regularizer]:
    """Return the members of a chain in order."""
    if type(module) is Chain:  # a subclass may do something else with its members than one after the other
        return list(module)
    if isinstance(module, nn.Sequential) and type(module).forward is nn.Sequential.forward:
        return [member for child in module for member in _flatten(child)]
    return [module if isinstance(module, Regularizer) else WrappedModule(module)]


def _combine_draws(draws: Sequence[Draw | None]) -> Draw:
    """Combine the draws of all members: a Gaussian is kept if no member drops it."""
    kept = [draw.keep for draw in draws if draw is not None and draw.keep is not None]
    return Draw(tuple(draws), functools.reduce(torch.logical_and, kept) if kept else None)


def _joint_mean(members: list[Regularizer], x: Params) -> Params:
    """Return the mean over the draws of members that each render theirs."""
    # The mean of a product is not the product of the means where the factor of one depends on the opacity that another
    # has changed, as that of clamped noise does; the moments of the composed factor account for that.
    if len(members) > 1 and (both := _alpha_factor(members, x, test=True)) is not None:
        return both[0]._replace(opacities=(both[0].opacities * both[1].mean).to(x.opacities.dtype))
    for member in members:
        x = member.expected(x)
    return x


def _alpha_factor(members: list[Regularizer], x: Params, *, test: bool = False) -> tuple[Params, Multiplier] | None:
    """Compose the members' multipliers; None if one has none or depends on the draw of another."""
    total, soft = Multiplier(1.0, 0.0), False
    for member in members:
        one = member.test_alpha_factor(x) if test else member.alpha_factor(x)
        # The clamp of noise depends on the opacity that it meets, which a soft factor in front makes random.
        if one is None or (soft and getattr(member, "field", "") == "opacities"):
            return None
        x, total, soft = one[0], total * one[1], soft or not member.drops
    return x, total


def _set_step(module: nn.Module, step: int) -> None:
    """Pass the step to the `set_step` of a module and its submodules, where they have one."""
    for part in module.modules():
        if callable(set_step := getattr(part, "set_step", None)):
            set_step(step)


def _evaluating(module: nn.Module) -> nn.Module:
    """Return a copy in ``eval()`` that shares all tensors with the module."""
    module = getattr(module, "_orig_mod", module)  # a compiled module calls the original, in its mode
    twin = object.__new__(type(module))  # not deepcopy: the twin must see the parameters as they are
    vars(twin).update(vars(module))
    parts = {name: None if part is None else _evaluating(part) for name, part in module._modules.items()}
    vars(twin).update(training=False, _modules=parts)
    return twin
