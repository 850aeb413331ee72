"""Who imports whom, read from the sources: floors, no arrow upward, and no circle, by imports of any kind.

Imports within functions and under TYPE_CHECKING count like all others: the first are circles in waiting, the second
circles of thought.
"""

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

FLOORS = (
    {"ca_reg"},
    {"integrations"},
    {"camera", "rotations", "devices", "threads", "compiled"},
    {"files", "json_files", "npy_files", "ply_files", "tensor_files"},
    {"render"},  # which thereby knows neither scenes nor the model
    {"renderers", "model"},
    {"scenes"},  # which may begin with a model
    {"training", "evaluation"},
    {"runs"},
    {"report", "viewer", "studies", "compat"},
    {"cli"},
)
"""The rooms from the ground up: `ca_reg`, `integrations`, and the folders and modules of `reference_trainer`."""

EXCEPTIONS = {("ca_reg.integrations.run", "reference_trainer.compat")}
"""The launcher's stand-in for CUDA, loaded if the user asks for it."""


def module_name(path: Path) -> str:
    """The name by which a source is imported; the folder integrations is installed below ca_reg."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("ca_reg", *parts) if parts[0] == "integrations" else parts).removesuffix(".__init__")


def imports(tree: ast.AST, package: str, modules: Mapping[str, object]) -> Iterator[str]:
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


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    """What every module imports, but for the exceptions."""
    folders = ("ca_reg", "integrations", "reference_trainer")
    paths = {module_name(path): path for folder in folders for path in (ROOT / folder).rglob("*.py")}
    found = {}
    for name, path in paths.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        targets = set(imports(ast.parse(path.read_text(encoding="utf-8")), package, paths)) - {name}
        found[name] = {target for target in targets if (name, target) not in EXCEPTIONS}
    return found


def room(module: str) -> str:
    """The room of a module."""
    first, *rest = module.split(".")
    if first == "reference_trainer":
        return rest[0] if rest else ""
    return "integrations" if rest[:1] == ["integrations"] else first


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Some circle of a graph; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def rooms(graph: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Which rooms the modules of every room import."""
    found: dict[str, set[str]] = {}
    for module, targets in graph.items():
        found.setdefault(room(module), set()).update({room(target) for target in targets} - {room(module)})
    return found


def test_the_modules_are_read(graph):
    """Guards the tests below, which an empty graph would pass: one import of each kind is found."""
    assert "reference_trainer.render.numba.engine" in graph["reference_trainer.render.engine"]  # within a function
    assert "ca_reg.schedules" in graph["ca_reg.regularizer"]
    assert "ca_reg.integrations._report" in graph["ca_reg.integrations.run"]  # relative
    assert {x for floor in FLOORS for x in floor} >= set(rooms(graph)) - {""}


def test_no_arrow_points_upward(graph):
    floor_of = {name: floor for floor, names in enumerate(FLOORS) for name in names}
    upward = [
        f"{module} -> {target}"
        for module, targets in graph.items()
        for target in targets
        if room(module) and room(target) and floor_of[room(module)] < floor_of[room(target)]
    ]
    assert not upward


def test_integrations_need_ca_reg_alone_and_ca_reg_nothing(graph):
    assert rooms(graph)["ca_reg"] == set()
    assert rooms(graph)["integrations"] == {"ca_reg"}


def test_there_is_no_circle_between_modules(graph):
    assert circle(graph) == []


def test_there_is_no_circle_between_rooms(graph):
    assert circle(rooms(graph)) == []


def test_a_circle_is_found():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}
