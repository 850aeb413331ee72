"""Reading untrusted JSON files, and settings from them."""

from __future__ import annotations

import json
import math
from inspect import formatannotation
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

__all__ = ["read_json", "settings_from"]

T = TypeVar("T")


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file.

    Raises ValueError, which names the file, if it is not JSON in UTF-8 or nested too deeply.
    """
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))  # Windows programs begin with a BOM
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from error


def settings_from(kind: type[T], values: Any, where: str) -> T:
    """Make a dataclass of plain fields from a JSON object; missing fields get their defaults.

    Fields hold numbers, strings, booleans, None or literal strings. Errors call the object ``where``.

    Raises:
        ValueError: if ``values`` is not an object, or a field is unknown, of the wrong type, not finite, beyond 64 bits
            or refused by ``kind``.

    Example:
        >>> from reference_trainer.training.config import TrainConfig
        >>> settings_from(TrainConfig, {"dropout": 0.2}, "config.json").dropout
        0.2
        >>> settings_from(TrainConfig, {"iterations": "many"}, "config.json")
        Traceback (most recent call last):
        ...
        ValueError: config.json: iterations must be int, got 'many'.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be an object, got {values!r:.80}.")
    hints = get_type_hints(kind)
    unknown = sorted(values.keys() - hints.keys())
    if unknown:
        raise ValueError(f"{where} has unknown settings {unknown[:8]}; another version may have written it.")
    for name, value in values.items():
        if not _allows(hints[name], value):
            raise ValueError(f"{where}: {name} must be {formatannotation(hints[name])}, got {value!r:.80}.")
        if type(value) is float and not math.isfinite(value):
            raise ValueError(f"{where}: {name} must be finite, got {value}.")
        if type(value) is int and value.bit_length() > 63:
            raise ValueError(f"{where}: {name} must fit into 64 bits.")
    try:
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error


def _allows(hint: Any, value: Any) -> bool:
    """Whether a JSON value matches a field's type: a class, a union of classes, or a Literal of strings."""
    if get_origin(hint) is Literal:
        return type(value) is str and value in get_args(hint)
    if get_args(hint):
        return any(_allows(option, value) for option in get_args(hint))
    return type(value) is hint or (type(value) is int and hint is float)  # a bool is no number here
