"""Who imports whom, read from the sources of a checkout, and the floors that no import may climb.

Imports within functions and under TYPE_CHECKING count like all others: the first are circles in waiting, the second
circles of thought.
"""

import ast
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

FLOORS = (
    {"ca_reg"},
    {"integrations"},
    {"camera", "rotations", "devices", "threads", "progress", "compiled"},
    {"files", "json_files", "npy_files", "ply_files", "tensor_files"},
    {"render"},  # which thereby knows neither scenes nor the model
    {"renderers", "model"},
    {"scenes"},  # which may begin with a model
    {"evaluation"},
    {"training"},
    {"runs"},
    {"report", "viewer", "studies", "compat"},
    {"cli"},
)
"""The rooms from the ground up: `ca_reg`, `integrations`, and the folders and modules of `reference_trainer`."""

EXCEPTIONS = {("ca_reg.integrations.run", "reference_trainer.compat")}
"""The launcher's stand-in for CUDA, loaded if the user asks for it."""

Graph = Mapping[str, set[str]]
"""What every module imports."""


def sources(root: Path) -> dict[str, Path]:
    """The modules of the three packages by their name when imported; integrations is installed below ca_reg."""
    found = {}
    for folder in ("ca_reg", "integrations", "reference_trainer"):
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            name = ".".join(("ca_reg", *parts) if folder == "integrations" else parts)
            found[name.removesuffix(".__init__")] = path
    return found


def import_graph(root: Path) -> dict[str, set[str]]:
    """What every module of a checkout imports, but for the exceptions."""
    paths = sources(root)
    found = {}
    for name, path in paths.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        targets = set(_imports(ast.parse(path.read_text(encoding="utf-8")), package, paths)) - {name}
        found[name] = {target for target in targets if (name, target) not in EXCEPTIONS}
    return found


def _imports(tree: ast.AST, package: str, modules: Iterable[str]) -> Iterator[str]:
    """The modules among ``modules`` that a source imports."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
            names = [name if name in modules else origin for name in names]
        yield from (name for name in names if name in modules)


def room(module: str) -> str:
    """The room of a module; none for the trainer's package itself."""
    first, *rest = module.split(".")
    if first == "reference_trainer":
        return rest[0] if rest else ""
    return "integrations" if rest[:1] == ["integrations"] else first


def rooms(graph: Graph) -> dict[str, set[str]]:
    """Which rooms the modules of every room import."""
    found: dict[str, set[str]] = {}
    for module, targets in graph.items():
        found.setdefault(room(module), set()).update({room(target) for target in targets} - {room(module)})
    return found


def upward(graph: Graph) -> list[str]:
    """The imports of a higher floor, each as "module -> module"."""
    floor_of = {name: floor for floor, names in enumerate(FLOORS) for name in names}
    pairs = [(a, b) for a, targets in sorted(graph.items()) for b in sorted(targets) if room(a) and room(b)]
    return [f"{a} -> {b}" for a, b in pairs if floor_of[room(a)] < floor_of[room(b)]]


def circle(graph: Graph) -> list[str]:
    """Some circle of a graph; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []
