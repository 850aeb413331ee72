"""Every behavior of the renderer, for every engine."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from importlib.metadata import Distribution, PackageNotFoundError

import pytest
import torch
from engines import CASES, ON_CARDS, Case
from stand_ins.card import CARD, pretended_card


@pytest.fixture(params=["torch", "numba"])
def engine(request, monkeypatch) -> str:
    """Each engine in turn renders what it can."""
    return chosen(request.param, monkeypatch)


@pytest.fixture
def unnamed(monkeypatch) -> Callable[[str], None]:
    """Let a package be importable, but not installed by its own name, as forks for AMD's cards are."""
    found = Distribution.from_name

    def unname(missing: str) -> None:
        def from_name(name):
            if name == missing:
                raise PackageNotFoundError(name)
            return found(name)

        monkeypatch.setattr(Distribution, "from_name", from_name)

    return unname


def chosen(name: str, monkeypatch: pytest.MonkeyPatch) -> str:
    if name in ("numba", "triton"):
        pytest.importorskip(name)
    monkeypatch.setenv("CA_REG_ENGINE", name)
    return name


@pytest.fixture(params=list(CASES))
def case(request, monkeypatch) -> Case:
    """Each engine in turn at every precision that it has, on the processor."""
    chosen(CASES[request.param].engine, monkeypatch)
    return CASES[request.param]


@pytest.fixture(
    params=[*CASES, *(pytest.param(name, marks=pytest.mark.gpu if "cuda" in name else ()) for name in ON_CARDS)]
)
def any_case(request, monkeypatch) -> Iterator[Case]:
    """The same on every device that this machine has, and on one that it only pretends to have."""
    case = (CASES | ON_CARDS)[request.param]
    if case.device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    chosen(case.engine, monkeypatch)
    with pretended_card() if case.device == CARD else nullcontext():
        yield case
