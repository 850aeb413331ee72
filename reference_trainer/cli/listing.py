"""How `--help` lists options: those of a training in groups, every text as one paragraph."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
from itertools import pairwise
from typing import Annotated, Any, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from reference_trainer.training.config import TrainConfig

__all__ = ["registry"]

GROUPS = {
    "iterations": "schedule", "dropout": "regularizer", "loss": "method", "sh_degree": "color",
    "means_rate": "learning_rate", "initial_points": "start", "densify_from": "density",
}  # fmt: skip
"""The groups of `TrainConfig`, by the first field of each."""

registry = ConstructorRegistry()
"""Tells tyro how to read the dataclasses whose fields are options."""


@registry.struct_rule
def _options(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return the fields of a dataclass of this package with their texts, those of a training in groups."""
    kind, default = info.type, info.default
    if not (dataclasses.is_dataclass(kind) and kind.__module__.startswith("reference_trainer.")):
        return None
    if kind.__module__ == __name__:  # a group, made below: tyro reads its fields, and it has no source
        return None
    given = vars(default) if isinstance(default, kind) else {}
    hints, texts = get_type_hints(kind, include_extras=True), _texts(kind)
    fields = []
    for each in dataclasses.fields(kind):
        value, hint = given.get(each.name, _default(each)), hints[each.name]
        if value is None or value in ("", ()):  # what that means the text says
            hint = Annotated[hint, tyro.conf.arg(help_behavior_hint="")]
        fields.append(StructFieldSpec(each.name, hint, value, texts.get(each.name)))
    if kind is not TrainConfig:
        return StructConstructorSpec(kind, tuple(fields))
    groups: dict[str, list[Any]] = {}
    for spec in fields:
        own = groups.setdefault(GROUPS.get(spec.name) or list(groups)[-1], [])
        own.append((spec.name, Annotated[spec.type, tyro.conf.arg(help=texts.get(spec.name))], spec.default))
    # From Python 3.12 on, this module would be theirs without being told.
    kinds = {x: dataclasses.make_dataclass(x, own, namespace={"__module__": __name__}) for x, own in groups.items()}
    return StructConstructorSpec(
        lambda **found: TrainConfig(**{name: x for group in found.values() for name, x in vars(group).items()}),
        tuple(StructFieldSpec(name, group, group()) for name, group in kinds.items()),
    )


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is dataclasses.MISSING else field.default


@functools.cache
def _texts(kind: type) -> dict[str, str]:
    """Return the texts below the fields of a dataclass; tyro would keep some of their line breaks."""
    found: dict[str, str] = {}
    for each in reversed([each for each in kind.__mro__ if dataclasses.is_dataclass(each)]):
        (definition,) = ast.parse(inspect.getsource(each)).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in pairwise(definition.body):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                found[field.target.id] = " ".join(ast.literal_eval(text.value).split())
    return found
