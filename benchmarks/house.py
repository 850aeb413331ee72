"""How large the code and its pages are, and whether it has floors: ``python -m benchmarks.house [ROOT]``.

Prints one table for the packages that are installed and one for the whole, then every circle of imports and every
import of a higher floor by name. Imports count wherever they stand: at the top of a module, in a function, for types.
"""

from __future__ import annotations

import argparse
import ast
import io
import statistics
import tokenize
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from reference_trainer.evaluation.tables import markdown_table

__all__ = ["circles", "comments_and_code", "imports", "main", "modules", "upward"]

GOALS = {"installed lines": 25_000, "lines of ca_reg": 5_000, "words in docs": 30_000, "names exported by ca_reg": 18,
         "circles of imports": 0, "imports of a higher floor": 0, "files per 1,000 lines": 6}  # fmt: skip

FLOORS = (
    "ca_reg",
    "camera rotations files json_files npy_files ply_files tensor_files threads devices compiled",
    "render",
    "model",
    "scenes",
    "evaluation renderers",
    "training.config training.interruption training.model_state training.randomness training.step",
    "training.losses training.density",
    "training compat",
    "runs",
    "report viewer studies",
    "cli",
)
"""From the ground up, as docs/architecture.md draws them; all but ``ca_reg`` are parts of ``reference_trainer``. What a
loss or a density strategy is given of a training lies below these."""


@dataclass(frozen=True)
class Module:
    """A module of an installed package: its file, its top-level package and its source."""

    file: Path
    package: str
    source: str

    @property
    def lines(self) -> int:
        """All lines of the file."""
        return self.source.count("\n")


def modules(root: Path) -> dict[str, Module]:
    """Return the modules that ``pyproject.toml`` installs, by their name when imported."""
    setuptools = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    found = {}
    for package in setuptools["packages"]:
        folder = root / setuptools.get("package-dir", {}).get(package, package.replace(".", "/"))
        top = "integrations" if package.startswith("ca_reg.integrations") else package.partition(".")[0]
        for file in sorted(folder.glob("*.py")):
            name = package if file.stem == "__init__" else f"{package}.{file.stem}"
            found[name] = Module(file, top, file.read_text("utf-8"))
    return found


def imports(name: str, module: Module, known: Iterable[str]) -> set[str]:
    """Return the modules among ``known`` that a module names in any import statement."""
    known, package = set(known), name if module.file.stem == "__init__" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(module.source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            parts = {f"{origin}.{alias.name}" for alias in node.names}
            found |= parts & known
            if not parts <= known:  # something of the module itself
                found.add(origin)
    return found & known - {name}


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other, directly or by way of others (Tarjan 1972).

    Example:
        >>> circles({"a": {"b"}, "b": {"a"}, "c": {"a"}})
        [['a', 'b']]
    """
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in order:
                visit(other)
            if other in stack:
                low[name] = min(low[name], low[other])
        if low[name] == order[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    for name in sorted(graph):
        if name not in order:
            visit(name)
    return found


def upward(graph: Mapping[str, set[str]]) -> list[tuple[str, str]]:
    """Return the imports of a higher floor; modules without a floor, such as those of integrations, are left out.

    Example:
        >>> upward({"reference_trainer.model.ply": {"reference_trainer.runs.run", "reference_trainer.camera"}})
        [('reference_trainer.model.ply', 'reference_trainer.runs.run')]
    """
    floors = {part: level for level, floor in enumerate(FLOORS) for part in floor.split()}

    def level(name: str) -> int | None:
        if name.startswith("ca_reg"):
            return None if name.startswith("ca_reg.integrations") else floors["ca_reg"]
        parts = name.split(".")[1:]
        return floors.get(".".join(parts[:2]), floors.get(parts[0]) if parts else None)

    pairs = [(a, b) for a in sorted(graph) for b in sorted(graph[a])]
    return [(a, b) for a, b in pairs if (x := level(a)) is not None and (y := level(b)) is not None and x < y]


def comments_and_code(source: str) -> tuple[int, int]:
    """Return the number of lines with a comment and of lines with code; docstrings are neither.

    Example:
        >>> comments_and_code('"Doc."\\n# why\\nx = 1  # unit\\n')
        (2, 1)
    """
    skipped = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER)
    comments, code = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments.add(token.start[0])
        elif token.type not in skipped:
            code |= {*range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):  # a docstring
                code -= {*range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    return len(comments), len(code)


def _row(title: str, of: list[Module]) -> dict[str, object]:
    lines = [module.lines for module in of]
    comments, code = (sum(column) for column in zip(*(comments_and_code(module.source) for module in of), strict=True))
    return {"": title, "lines": f"{sum(lines):,}", "files": len(of),
            "files per 1,000 lines": f"{1000 * len(of) / sum(lines):.1f}", "median": int(statistics.median(lines)),
            "longest": max(lines), "comments per 100 lines of code": f"{100 * comments / code:.1f}"}  # fmt: skip


def _tables(root: Path) -> Iterator[str]:
    found = modules(root)
    by_package: dict[str, list[Module]] = {}
    for module in found.values():
        by_package.setdefault(module.package, []).append(module)
    render = [module for name, module in found.items() if name.startswith("reference_trainer.render.")]
    rows = [_row(f"`{name}`", of) for name, of in by_package.items()]
    rows += [_row("`reference_trainer/render`", render)] if render else []
    rows += [_row("all that is installed", [*found.values()])]
    yield markdown_table(rows, list(rows[0]))

    graph = {name: imports(name, module, found) for name, module in found.items()}
    round_trips, higher = circles(graph), upward(graph)
    exported = next(
        node.value for node in ast.parse(found["ca_reg"].source).body
        if isinstance(node, ast.Assign) and any(getattr(x, "id", "") == "__all__" for x in node.targets)
    )  # fmt: skip
    lines = sum(module.lines for module in found.values())
    measured = {
        "installed lines": lines,
        "lines of ca_reg": sum(module.lines for module in by_package["ca_reg"]),
        "files per 1,000 lines": round(1000 * len(found) / lines, 1),
        "circles of imports": len(round_trips),
        "imports of a higher floor": len(higher),
        "names exported by ca_reg": len([name for name in ast.literal_eval(exported) if not name.startswith("_")]),
        "words in docs": sum(len(page.read_text("utf-8").split()) for page in (root / "docs").glob("*.md")),
    }
    whole: list[dict[str, object]] = [
        {"": name, "now": f"{value:,}", "goal": f"{GOALS[name]:,}"} for name, value in measured.items()
    ]
    yield markdown_table(whole, ["", "now", "goal"])
    yield "".join(f"- circle: {', '.join(group)}\n" for group in round_trips)
    yield "".join(f"- upward: {a} imports {b}\n" for a, b in higher)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables of a checkout."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.house", description=main.__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1], help="root of a checkout")
    print("\n".join(text for text in _tables(parser.parse_args(arguments).root) if text), end="")


if __name__ == "__main__":
    main()
