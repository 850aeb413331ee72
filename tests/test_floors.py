"""No import of any kind points to a higher floor or closes a circle."""

from pathlib import Path

import pytest
from floors import FLOORS, Graph, circle, import_graph, rooms, upward


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


def test_there_is_no_circle_between_modules(graph):
    assert circle(graph) == []


def test_there_is_no_circle_between_rooms(graph):
    assert circle(rooms(graph)) == []


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
