"""The table of the house, on a small checkout whose figures are known."""

import pytest

from benchmarks import house

FILES = {
    "pyproject.toml": '[tool.setuptools]\npackages = ["ca_reg", "reference_trainer", "reference_trainer.model", '
    '"reference_trainer.runs", "ca_reg.integrations"]\npackage-dir = { "ca_reg.integrations" = "integrations" }\n',
    "ca_reg/__init__.py": '"""Doc."""\n\nfrom ca_reg.a import f\n\n__all__ = ["f", "__version__"]\n',
    "ca_reg/a.py": "def f():\n    from ca_reg import b  # late\n    return b\n",
    "ca_reg/b.py": "# why\nimport ca_reg.a\n",
    "integrations/__init__.py": "from reference_trainer.runs import run\n",
    "reference_trainer/__init__.py": "",
    "reference_trainer/model/__init__.py": "",
    "reference_trainer/model/ply.py": "from ..runs.run import main\nfrom . import other\n",
    "reference_trainer/model/other.py": "",
    "reference_trainer/runs/__init__.py": "",
    "reference_trainer/runs/run.py": "from ca_reg import f\nmain = f\n",
    "docs/page.md": "# Four words in all\n",
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_imports_are_found_wherever_they_stand(checkout):
    found = house.modules(checkout)
    graph = {name: house.imports(name, module, found) for name, module in found.items()}
    assert graph["ca_reg.a"] == {"ca_reg.b"}
    assert graph["ca_reg"] == {"ca_reg.a"}
    assert graph["reference_trainer.model.ply"] == {"reference_trainer.runs.run", "reference_trainer.model.other"}
    assert graph["reference_trainer.runs.run"] == {"ca_reg"}
    assert house.circles(graph) == [["ca_reg.a", "ca_reg.b"]]
    assert house.upward(graph) == [("reference_trainer.model.ply", "reference_trainer.runs.run")]


def test_the_table_counts_what_is_there(checkout, capsys):
    house.main([str(checkout)])
    text = capsys.readouterr().out
    for line in ("| installed lines | 15 |", "| lines of ca_reg | 10 |", "| words in docs | 5 |",
                 "| names exported by ca_reg | 1 |", "| circles of imports | 1 |",
                 "- circle: ca_reg.a, ca_reg.b"):  # fmt: skip
        assert line in text


def test_every_folder_of_the_trainer_has_a_floor():
    named = {part.partition(".")[0] for floor in house.FLOORS for part in floor.split()}
    found = {name.split(".")[1] for name in house.modules(house.Path(__file__).parents[2]) if name.count(".") > 0
             and name.startswith("reference_trainer.")}  # fmt: skip
    assert found <= named
