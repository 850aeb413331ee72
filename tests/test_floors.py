"""No import of any kind points to a higher floor or closes a circle."""

import ast
import re
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from floors import FLOORS, Graph, circle, import_graph, rooms, sources, upward


@pytest.fixture(scope="module")
def graph() -> Graph:
    """What every module of this checkout imports."""
    return import_graph(Path(__file__).parents[1])


def test_the_modules_are_read(graph):
    """Guards the tests below, which an empty graph would pass: one import of each kind is found."""
    assert "reference_trainer.runs.measure" in graph["reference_trainer.cli.models"]  # within a function
    assert "ca_reg.schedules" in graph["ca_reg.regularizer"]
    assert "ca_reg.integrations._report" in graph["ca_reg.integrations.run"]  # relative
    assert {x for floor in FLOORS for x in floor} >= set(rooms(graph)) - {""}


def test_no_arrow_points_upward(graph):
    assert upward(graph) == []


def test_integrations_need_ca_reg_alone_and_ca_reg_nothing(graph):
    assert rooms(graph)["ca_reg"] == set()
    assert rooms(graph)["integrations"] == {"ca_reg"}


def test_nothing_that_is_installed_imports_what_only_a_checkout_has():
    for name, path in sources(Path(__file__).parents[1]).items():
        tops = set[str]()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                tops |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                tops.add((node.module or "").partition(".")[0])
        assert not tops & {"tests", "benchmarks"}, name


def test_there_is_no_circle_between_modules(graph):
    assert circle(graph) == []


def test_there_is_no_circle_between_rooms(graph):
    assert circle(rooms(graph)) == []


def test_what_is_imported_from_elsewhere_is_declared():
    """A package that only others bring along, such as rich, is missing one day."""
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    asked = [project["dependencies"], *project["optional-dependencies"].values()]
    declared = {_distribution(each) for group in asked for each in group}
    declared |= {"llvmlite", "cycler"}  # numba's and matplotlib's, which cannot do without
    imported: dict[str, str] = {}
    rooms_of_the_package = ("ca_reg", "integrations", "reference_trainer")
    for path in [path for room in rooms_of_the_package for path in (root / room).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            imported |= {name.partition(".")[0]: str(path.relative_to(root)) for name in names}
    brought = {name: set(map(_distribution, of)) for name, of in packages_distributions().items() if name in imported}
    assert brought["PIL"] == {"pillow"}
    assert not {name: imported[name] for name, of in brought.items() if declared.isdisjoint(of)}


def _distribution(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


FILES = {
    "ca_reg/__init__.py": "from ca_reg.a import f\n",
    "ca_reg/a.py": "def f():\n    from ca_reg import b\n    return b\n",
    "ca_reg/b.py": "import ca_reg.a\n",
    "integrations/__init__.py": "",
    "reference_trainer/__init__.py": "",
    "reference_trainer/model/__init__.py": "",
    "reference_trainer/model/ply.py": "from ..runs.run import main\nfrom . import other\n",
    "reference_trainer/model/other.py": "",
    "reference_trainer/runs/__init__.py": "",
    "reference_trainer/runs/run.py": "from ca_reg import f\nmain = f\n",
}


def test_arrows_and_circles_are_found_wherever_imports_stand(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = import_graph(tmp_path)
    assert found["ca_reg.a"] == {"ca_reg.b"}
    assert found["reference_trainer.model.ply"] == {"reference_trainer.runs.run", "reference_trainer.model.other"}
    assert found["reference_trainer.runs.run"] == {"ca_reg"}
    assert upward(found) == ["reference_trainer.model.ply -> reference_trainer.runs.run"]
    assert set(circle(found)) == {"ca_reg.a", "ca_reg.b"}
