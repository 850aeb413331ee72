"""Which variant of the rasterizer and of ``simple_knn`` a repository was written for: read from its source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

__all__ = ["Interface", "Outputs", "read_interface"]

Outputs = Literal[2, 3, 4, "depth", "inverse-depth"]
"""What a rasterizer returns: (colour, radii), and then nothing (2), one plane (3, or which), or depth and alpha (4)."""

RASTERIZERS = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs")
MEMBERS: dict[int | str, tuple[str, ...]] = {
    2: (),
    "depth": ("depth",),
    "inverse-depth": ("inverse_depth",),
    4: ("depth", "alpha"),
}
SAY_IT = "outputs=2, 4, 'depth' or 'inverse-depth', in the launcher --outputs"


class Interface(NamedTuple):
    """What a repository expects of its CUDA extensions.

    That is the rasterizer's module, what it returns after colour and radii, and whether ``distCUDA2`` returns the
    neighbours' numbers as well.
    """

    rasterizer: str
    members: tuple[str, ...]
    neighbor_indices: bool


def read_interface(repository: Path, outputs: Outputs | None = None) -> Interface:
    """Read ``gaussian_renderer/__init__.py`` and ``scene/`` without importing them; ``outputs`` says it instead.

    The number of outputs is that of the names to which the result of the rasterizer is assigned; if it is not taken
    apart there, a field of the settings may tell. A third of three outputs is what the settings tell, too: those with
    ``antialiasing`` (INRIA since October 2024) go with inverse depths, and no other field says what it is.

    Raises:
        ValueError: if the outputs cannot be told, or no rasterizer has them.
    """
    source = repository / "gaussian_renderer" / "__init__.py"
    tree = ast.parse(source.read_text(encoding="utf-8")) if source.is_file() else ast.Module([], [])
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    rasterizer = next((name for name in RASTERIZERS if name in imported), RASTERIZERS[0])
    settings = {
        keyword.arg
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and _called(node) == "GaussianRasterizationSettings"
        for keyword in node.keywords
    }
    found = _count_outputs(tree, source, settings) if outputs is None else outputs
    if rasterizer.endswith("_abs"):
        if found != 3:
            raise ValueError(
                f"{rasterizer} returns 3 values (colour, radii, weights), got outputs={found} for {source}."
            )
        return Interface(rasterizer, ("weights",), _neighbor_indices(repository))
    if found == 3:
        if "antialiasing" not in settings:
            raise ValueError(
                f"cannot tell what the third of three values is that the rasterizer of {source} returns: an inverse "
                "depth in INRIA's code, whose settings have a field antialiasing, which these have not; a depth, or a "
                f"number per Gaussian, in others. If it is a depth, say which: {SAY_IT}."
            )
        found = "inverse-depth"
    if found not in MEMBERS:
        raise ValueError(f"no known rasterizer returns outputs={found} for {source}. Give {SAY_IT}.")
    return Interface(rasterizer, MEMBERS[found], _neighbor_indices(repository))


def _count_outputs(tree: ast.Module, source: Path, settings: set[str | None]) -> int | str:
    """Count the names that the results of the rasterizer are assigned to."""
    if not source.is_file():
        raise ValueError(f"there is no {source} to read the rasterizer's outputs from. Give {SAY_IT}.")
    assignments = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    rasterizers = {
        target.id
        for node in assignments
        if _called(node.value) == "GaussianRasterizer"
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    counts = {
        len(target.elts)
        for node in assignments
        if _called(node.value) in rasterizers
        for target in node.targets
        if isinstance(target, ast.Tuple) and not any(isinstance(name, ast.Starred) for name in target.elts)
    }
    if not counts:
        counts = {count for field, count in {"confidence": 4, "antialiasing": 3}.items() if field in settings}
    if len(counts) != 1:
        raise ValueError(
            f"cannot tell how many values the rasterizer returns from {source}: its results are taken apart into "
            f"{sorted(counts) or 'no fixed number of'} names. Give {SAY_IT}."
        )
    return counts.pop()


def _neighbor_indices(repository: Path) -> bool:
    """Whether the results of ``distCUDA2`` are taken apart anywhere in the scene package."""
    return any(
        (isinstance(node, ast.Subscript) and _called(node.value) == "distCUDA2")
        or (
            isinstance(node, ast.Assign)
            and _called(node.value) == "distCUDA2"
            and any(isinstance(target, ast.Tuple) for target in node.targets)
        )
        for node in _nodes(repository / "scene")
    )


def _nodes(folder: Path) -> Iterator[ast.AST]:
    """Iterate over the syntax of all Python files in a folder."""
    for path in sorted(folder.rglob("*.py")):
        yield from ast.walk(ast.parse(path.read_text(encoding="utf-8")))


def _called(node: ast.AST) -> str | None:
    """Name of the function that an expression calls, if it is a plain name."""
    return node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else None
