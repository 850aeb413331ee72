"""Translate between the arguments of a rasterizer call and `Params`, and apply regularizers to the call."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ca_reg import Chain, Params

from ._tally import Skip, Tally

__all__ = ["Call", "chain_of"]

_OF_CALL = ("view_matrix", "step")  # fields that are not per Gaussian


def chain_of(regularizer: nn.Module) -> Chain:
    """Wrap a user's regularizer in a chain; TypeError if it is not a module, ValueError if it learns per Gaussian."""
    chain = Chain(regularizer)
    if chain.learns:
        raise ValueError(
            f"{_who(chain, 'learns', *chain.learns)} learns {', '.join(chain.learns)} for each Gaussian, which only "
            "the bundled trainer (ca-reg train) can keep with the Gaussians: train there, or leave it out."
        )
    return chain


class Call:
    """A call of a rasterizer whose bound arguments may be changed before it is made.

    Attributes:
        arguments: the bound arguments by name.
        names: argument names by field of :class:`~ca_reg.Params`, where the two differ.
        instead: which arguments replace these in some calls, for messages.
    """

    names: ClassVar[Mapping[str, str]] = {}
    instead: ClassVar[str] = ""

    def __init__(self, function: Callable[..., Any], bound: inspect.BoundArguments) -> None:
        self.function = function
        self.arguments = bound.arguments
        self._bound = bound

    def __call__(self) -> Any:
        """Rasterize."""
        return self.function(*self._bound.args, **self._bound.kwargs)

    def takes(self, name: str) -> bool:
        """Whether the function has an argument of this name, given or not."""
        return name in self._bound.signature.parameters

    @classmethod
    def check(cls, chain: Chain, signature: inspect.Signature) -> None:
        """Raise a ValueError if a regularizer needs a field that no call with this signature can supply."""
        for name in chain.needs:
            if name not in Params._fields or cls.names.get(name, name) not in (*signature.parameters, *_OF_CALL):
                raise ValueError(
                    f"{_who(chain, 'needs', name)} needs {name}, which this rasterizer does not take; it takes "
                    f"{', '.join(signature.parameters)}."
                )

    def get(self, field: str) -> Tensor | None:
        """Return a field as the rasterizer takes it; None if this call does not have it."""
        value: Tensor | None = self.arguments.get(self.names.get(field, field))
        return value

    def put(self, field: str, value: Tensor) -> None:
        """Replace a field."""
        if field in _OF_CALL:
            raise ValueError(
                f"a regularizer changed {field}, which belongs to the call and is no field of the Gaussians."
            )
        name = self.names.get(field, field)
        self.arguments[name] = value.reshape(self.arguments[name].shape)

    def params(self, chain: Chain, step: int) -> Params:
        """Return the opacities (N,) and the other needed fields, batches flattened; ValueError if one is missing."""
        opacities = self.arguments["opacities"].reshape(-1)
        found: dict[str, Any] = {}
        for name in chain.needs:
            if name in ("opacities", "step"):
                continue
            value = self.get(name)
            if value is not None and name != "view_matrix":
                value = value.flatten(0, -3 if name == "sh" else -2)
            if value is None or (name != "view_matrix" and len(value) != len(opacities)):
                raise ValueError(
                    f"{_who(chain, 'needs', name)} needs {name}, which this call of the rasterizer does not have for "
                    f"every Gaussian: {self.instead}."
                )
            found[name] = value
        return Params(opacities, step=step, **found)

    def train(self, chain: Chain, step: int, tally: Tally, generator: torch.Generator | None) -> Tensor | None:
        """Apply a draw to the arguments; return which Gaussians it kept, None if it dropped none."""
        given = self.params(chain, step)
        if self._replace(given, chain(given, generator=generator)):
            tally.count_regularized(step)
        else:
            tally.skipped[Skip.RATE_ZERO] += 1
        return chain.keep

    def evaluate(self, chain: Chain, step: int, tally: Tally) -> None:
        """Apply the test-time values to the arguments."""
        given = self.params(chain, step)
        if self._replace(given, chain.expected(given)):
            tally.scaled += 1
        else:
            tally.skipped[Skip.NOTHING_TO_SCALE] += 1

    def _replace(self, before: Params, after: Params) -> bool:
        """Put the changed fields into the arguments; return whether there were any."""
        changed = [name for name in Params._fields if getattr(after, name) is not getattr(before, name)]
        for name in changed:
            self.put(name, getattr(after, name))
        return bool(changed)


def _who(chain: Chain, attribute: str, *names: str) -> str:
    """Return the type names of the members that need, or learn, one of these names."""
    return ", ".join(type(member).__name__ for member in chain if set(names) & set(getattr(member, attribute)))
