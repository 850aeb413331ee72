"""Ways to damage what a checkpoint says while its file stays intact, as functions of the state and random numbers."""

from __future__ import annotations

import copy
import functools
import io
import json
import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["STATE_MUTATIONS"]

_NUMBERS = (0.0, -1.0, 0.5, 1e-45, 1e10, 3e38, -3e38, float("nan"), float("inf"), -float("inf"))
_SETTINGS: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 7, 10**5, 2**31, 2**62, 2**63 - 1, 2**63, 10**400, "", "x", "all", [], {}, [1]),
    *(0.0, -0.5, 0.5, 1.0, 1e-300, 1e-30, 1e30, 1e300, -1e300, float("nan"), float("inf")),
)
_VALUES: tuple[Any, ...] = (
    *_SETTINGS, "a" * 5000, "é\ud800", b"bytes", (1, 2), [0] * 100, [[[None]]], {"a": 1}, {1: 2}, {None: "x"},
    torch.zeros(()), torch.zeros(0), torch.ones(3), torch.ones(2, 2, dtype=torch.int64), [torch.zeros(1)],
)  # fmt: skip
_DTYPES = (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool)


def _places(x: Any, tensors: bool) -> list[tuple[Any, Any]]:
    """Return all dicts and lists in a nested value with their keys: those of tensors alone, or all."""
    found: list[tuple[Any, Any]] = []
    pending = [x]
    while pending:
        node = pending.pop()
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            if isinstance(node[key], Tensor) or not tensors:
                found.append((node, key))
            if isinstance(node[key], dict | list):
                pending.append(node[key])
    return found


def _entry(state: dict[str, Any], rng: random.Random) -> None:
    """Remove, rename, add, exchange or replace an entry anywhere."""
    places = _places(state, tensors=False)
    node, key = rng.choice(places)
    match rng.randrange(5):
        case 0:
            del node[key]
        case 1 if isinstance(node, dict):
            node[rng.choice(("", "x", 3, None, f"{key}s"))] = node.pop(key)
        case 2 if isinstance(node, dict):
            node[rng.choice(("", "x", 3, None, f"{key}s", "max_exp_avg_sq"))] = rng.choice((*_VALUES, node[key]))
        case 3:
            other, place = rng.choice(places)
            node[key], other[place] = other[place], node[key]
        case _:
            node[key] = rng.choice(_VALUES)


def _values(state: dict[str, Any], rng: random.Random) -> None:
    """Set one number of a tensor, a row of it or all of them to an absurd one."""
    node, key = rng.choice(_places(state, tensors=True))
    x = node[key].clone()
    row = x if x.ndim == 0 else x[rng.randrange(len(x))]
    rng.choice((x, row, row.reshape(-1)[:1])).fill_(rng.choice(_NUMBERS))
    node[key] = x


def _shape(state: dict[str, Any], rng: random.Random) -> None:
    """Cut, lengthen, flatten, nest or turn a tensor."""
    node, key = rng.choice(_places(state, tensors=True))
    x = node[key]
    shapes = [x[None], x[..., None], x.reshape(-1), x.reshape(-1)[:0], x.reshape(-1)[:1], x.reshape(-1)[0]]
    if x.ndim:
        shapes += [x[:-1], x[:0], torch.cat([x, x]), torch.cat([x, x[:1]]), x.transpose(0, -1), x[..., :-1]]
    node[key] = rng.choice(shapes).clone()


def _kind(state: dict[str, Any], rng: random.Random) -> None:
    """Make another kind of tensor of one, or a list."""
    node, key = rng.choice(_places(state, tensors=True))
    x = node[key]
    match rng.randrange(4):
        case 0:
            node[key] = x.to(rng.choice(_DTYPES))
        case 1:
            node[key] = x.clone().requires_grad_()
        case 2:
            node[key] = torch.nn.Parameter(x)
        case _:
            node[key] = x.tolist()


def _memory(state: dict[str, Any], rng: random.Random) -> None:
    """Let tensors share their memory: two with each other, or one with itself."""
    (node, key), (other, place) = (rng.choice(_places(state, tensors=True)) for _ in range(2))
    x = node[key]
    match rng.randrange(3):
        case 0:
            node[key] = other[place]
        case 1 if x.ndim:
            node[key] = x.clone().as_strided(x.shape, [1] * x.ndim)
        case _:
            node[key] = torch.cat([x.reshape(-1)] * 3)[1::2][: x.numel()].reshape(x.shape)


def _count(state: dict[str, Any], rng: random.Random) -> None:
    """Change the number of Gaussians everywhere, which is no damage unless none is left."""
    n = len(state["gaussians"]["means"])
    index = torch.arange(rng.choice((0, 1, n - 1, n, 2 * n))) % n
    for node, key in _places(state, tensors=True):
        if node[key].ndim:
            node[key] = node[key][index]


def _share(state: dict[str, Any], rng: random.Random) -> None:
    """Put in a pair of pairs of pairs, each the same one twice: few bytes that stand for 2 ** 40 containers."""
    x: Any = rng.choice(([], {}, ()))
    for _ in range(40):
        x = rng.choice(([x, x], {"a": x, "b": x}, (x, x)))
    node, key = rng.choice(_places(state, tensors=False))
    node[key] = x


def _setting(state: dict[str, Any], rng: random.Random) -> None:
    """Change the settings, or the text that they stand in."""
    config = json.loads(state["config"])
    match rng.randrange(8):
        case 0:
            text = state["config"]
            text = text.decode() if isinstance(text, bytes) else text  # which an earlier change has made of it
            state["config"] = rng.choice((text[: rng.randrange(len(text))], text.encode(), "[" * 10**5, "9" * 5000))
            return
        case 1:
            del config[rng.choice(list(config))]
        case 2:
            config[rng.choice(("", "x", "Seed"))] = rng.choice(_SETTINGS)
        case _:
            config[rng.choice(list(config))] = rng.choice(_SETTINGS)
    state["config"] = json.dumps(config)


@functools.lru_cache(maxsize=1)
def _content(data: bytes) -> Any:
    """Return what is in a good file."""
    return torch.load(io.BytesIO(data), weights_only=True)


def _saved(change: Callable[[dict[str, Any], random.Random], None]) -> Callable[[bytes, random.Random], bytes]:
    """Make a mutation of a file out of one of its content."""

    def mutation(data: bytes, rng: random.Random) -> bytes:
        state = copy.deepcopy(_content(data))
        for _ in range(rng.choice((1, 1, 1, 2))):
            try:
                change(state, rng)
            except (LookupError, ValueError, RuntimeError, TypeError):  # the first change left nothing for a second
                break
        content = io.BytesIO()
        torch.save(state, content)
        return content.getvalue()

    return mutation


STATE_MUTATIONS = {
    name: _saved(change)
    for name, change in (
        ("entry", _entry), ("values", _values), ("shape", _shape), ("kind", _kind), ("memory", _memory),
        ("count", _count), ("setting", _setting), ("share", _share),
    )
}  # fmt: skip
