"""The plan of a training: what it uses and what it leaves out, decided from the scene before it begins."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from reference_trainer.scenes.scene import Scene
from reference_trainer.training.assembly import check
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan_rules import RULES, PlanItem, unseen

__all__ = ["Plan", "PlanItem", "make_plan"]


@dataclass(frozen=True)
class Plan:
    """The decisions about one scene; plain data that is stored with the run.

    Example:
        >>> plan = Plan((PlanItem("SH bands", "reduced", "3 views", {"sh_degree": 0}),))
        >>> plan.applied(TrainConfig(dropout=0.2)) == TrainConfig(dropout=0.2, sh_degree=0)
        True
        >>> Plan.from_dict(plan.as_dict()) == plan
        True
    """

    items: tuple[PlanItem, ...]

    def applied(self, config: TrainConfig, *, given: Collection[str] = ()) -> TrainConfig:
        """Return the settings with the changes of all items, except to fields that are ``given`` or not at default."""
        fixed = _fixed(config, given)
        changes = {name: value for item in self.items for name, value in item.changes.items() if name not in fixed}
        return dataclasses.replace(config, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Plan:
        """Restore what `as_dict` returned.

        Raises:
            ValueError: if it is something else.
        """
        try:
            return cls(tuple(PlanItem(**item) for item in data["items"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"expected a plan (plan.json of a run), got other data: {error}.") from error

    def summary(self) -> str:
        """Return what matters in a few lines: what changes, whether dropout is recommended, and what else can be had.

        Example:
            >>> print(Plan((PlanItem("SH bands", "reduced", "the others would stay 0", {"sh_degree": 0}),)).summary())
            Training changes 1 setting: sh_degree=0 (the others would stay 0).
        """
        changing = [item for item in self.items if item.changes]
        changes = [f"{name}={value} ({item.reason})" for item in changing for name, value in item.changes.items()]
        what = f"{len(changes)} setting{'s' * (len(changes) != 1)}: {'; '.join(changes)}" if changes else "no setting"
        dropout = [f"Dropout is {item.decision}: {item.reason}." for item in self.items if item.name == "dropout"]
        others = [item for item in self.items if item.decision == "recommended" and item.name != "dropout"]
        others += [item for item in self.items if item.decision == "left out" and " --" in item.reason]  # by an option
        told = [f"{item.decision.capitalize()}, {item.name}: {item.reason}." for item in others]
        return "\n".join([f"Training changes {what}.", *dropout, *told])

    def rows(self) -> list[dict[str, object]]:
        """Return one row per item, for a table with the columns item, decision, change and reason."""
        return [
            {
                "item": item.name,
                "decision": item.decision,
                "change": ", ".join(f"{name}={value}" for name, value in item.changes.items()) or "-",
                "reason": item.reason,
            }
            for item in self.items
        ]


def make_plan(
    scene: Scene, config: TrainConfig, *, given: Collection[str] = (), device: torch.device | str = "cpu"
) -> Plan:
    """Look at a scene and decide what its training needs.

    A choice of the user always wins: fields of ``config`` that differ from the defaults of `TrainConfig` (a recipe's
    among them), and those that ``given`` names because they were asked for at their default, are never changed.
    ``device`` renders what the plan must see rendered. Raises ValueError if ``given`` names something that is not a
    field of `TrainConfig`.

    Example:
        >>> from reference_trainer.scenes import synthetic_scene
        >>> plan = make_plan(synthetic_scene(width=32, height=24, points=100), TrainConfig())
        >>> {item.name: item.decision for item in plan.items}["depth output"]
        'left out'
    """
    if unknown := set(given) - {f.name for f in dataclasses.fields(TrainConfig)}:
        raise ValueError(f"given must name fields of TrainConfig, got {sorted(unknown)}.")
    check(config)
    fixed, items = _fixed(config, given), list[PlanItem]()
    for each in RULES:
        rule = partial(each, device=device) if each is unseen else each  # the one that renders
        item = rule(scene, config)
        if asked := ", ".join(f"{name}={getattr(config, name)}" for name in item.changes if name in fixed):
            item = PlanItem(item.name, "used", f"asked for ({asked}); the plan alone: {item.reason}")
        items.append(item)
        config = dataclasses.replace(config, **item.changes)  # what is left out depends on the size
    return Plan(tuple(items))


def _fixed(config: TrainConfig, given: Collection[str]) -> set[str]:
    """Fields that the plan must not touch."""
    # A value at its default may have been asked for: `given` tells, the value cannot.
    default = vars(TrainConfig())
    return {*given, *(name for name, value in vars(config).items() if value != default[name])}
