"""Which variant of the rasterizer and of ``simple_knn`` a repository was written for: read from its source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

__all__ = ["Interface", "read_interface"]

RASTERIZERS = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs")
OUTPUTS_OF_SETTINGS = {"confidence": 4, "antialiasing": 3}  # fields that only one variant of the settings has


class Interface(NamedTuple):
    """What a repository expects of its CUDA extensions.

    Args:
        rasterizer: module name.
        outputs: how many values the rasterizer returns.
        neighbor_indices: whether ``distCUDA2`` returns the neighbours' numbers as well.
    """

    rasterizer: str
    outputs: int
    neighbor_indices: bool


def read_interface(repository: Path, outputs: int | None = None) -> Interface:
    """Read ``gaussian_renderer/__init__.py`` and ``scene/`` without importing them.

    The number of outputs is that of the names to which the result of the rasterizer is assigned; if it is not taken
    apart there, a field of the settings may tell.

    Args:
        repository: the root of the foreign repository.
        outputs: 2, 3 or 4 to say it instead.

    Raises:
        ValueError: if the number cannot be told, or is none of 2, 3 and 4.
    """
    source = repository / "gaussian_renderer" / "__init__.py"
    tree = ast.parse(source.read_text(encoding="utf-8")) if source.is_file() else ast.Module([], [])
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    rasterizer = next((name for name in RASTERIZERS if name in imported), RASTERIZERS[0])
    if outputs is None:
        outputs = _outputs(tree, source)
    if outputs not in (2, 3, 4):
        raise ValueError(f"a rasterizer returns 2, 3 or 4 values, got outputs={outputs} for {source}.")
    if rasterizer.endswith("_abs") and outputs != 3:
        raise ValueError(f"{rasterizer} returns 3 values (colour, radii, weights), got outputs={outputs} for {source}.")
    return Interface(rasterizer, outputs, _neighbor_indices(repository))


def _outputs(tree: ast.Module, source: Path) -> int:
    """Count the names that the results of the rasterizer are assigned to."""
    if not source.is_file():
        raise ValueError(f"there is no {source} to read the rasterizer's outputs from: give outputs=2, 3 or 4.")
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
    } or {
        OUTPUTS_OF_SETTINGS[keyword.arg]
        for node in ast.walk(tree)
        if _called(node) == "GaussianRasterizationSettings" and isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg in OUTPUTS_OF_SETTINGS
    }
    if len(counts) != 1:
        raise ValueError(
            f"cannot tell how many values the rasterizer returns from {source}: its results are taken apart into "
            f"{sorted(counts) or 'no fixed number of'} names. Give outputs=2, 3 or 4."
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
