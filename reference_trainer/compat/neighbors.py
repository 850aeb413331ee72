"""The public interface of ``simple_knn``: mean squared distances to the three nearest neighbours."""

from __future__ import annotations

import importlib.machinery
from types import ModuleType

from torch import Tensor

from ca_reg.neighbors import nearest_neighbors

__all__ = ["neighbor_modules"]


def neighbor_modules(*, indices: bool) -> dict[str, ModuleType]:
    """Make the modules ``simple_knn`` and ``simple_knn._C``.

    Args:
        indices: whether ``distCUDA2`` returns the neighbours' numbers too, as the version of FSGS and CoR-GS does.
    """

    def distCUDA2(points: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return mean squared distances to the three nearest neighbours, shape (N,), and their numbers if so built."""
        squares, numbers = nearest_neighbors(points, 3)
        return (squares.mean(1), numbers.int()) if indices else squares.mean(1)

    package, compiled = ModuleType("simple_knn"), ModuleType("simple_knn._C")
    package.__spec__ = importlib.machinery.ModuleSpec("simple_knn", loader=None, is_package=True)
    compiled.__spec__ = importlib.machinery.ModuleSpec("simple_knn._C", loader=None)
    package.__path__ = []
    package._C = compiled  # type: ignore[attr-defined]
    compiled.distCUDA2 = distCUDA2  # type: ignore[attr-defined]
    return {"simple_knn": package, "simple_knn._C": compiled}
