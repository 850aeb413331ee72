"""What the tests of the INRIA hook and of the launcher share."""

import importlib
import sys
import textwrap
from types import ModuleType

import pytest
from launched import FILES
from pages import ROOT, blocks
from stand_ins.inria import Model, make_rasterizer


@pytest.fixture
def rasterizer():
    return make_rasterizer()


@pytest.fixture
def model_class(monkeypatch):
    """A fresh GaussianModel where the code bases have theirs."""

    class GaussianModel(Model):
        def update_learning_rate(self, iteration):
            return super().update_learning_rate(iteration)

    module = ModuleType("scene.gaussian_model")
    module.GaussianModel = GaussianModel
    monkeypatch.setitem(sys.modules, "scene.gaussian_model", module)
    return GaussianModel


@pytest.fixture
def my_module(tmp_path, monkeypatch):
    """The file of docs/write_your_own.md in the present folder, imported."""
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "my_module.py").write_text(blocks(ROOT / "docs" / "write_your_own.md", "python")[0])
    monkeypatch.chdir(tmp_path / "own")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    importlib.invalidate_caches()
    yield importlib.import_module("my_module")
    del sys.modules["my_module"]


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A code base, with the state of the interpreter put back after the test."""
    for name, text in FILES.items():
        path = tmp_path / "repository" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    for name in ("argv", "path", "meta_path"):
        monkeypatch.setattr(sys, name, list(getattr(sys, name)))
    sys.path.insert(0, "")  # python -m puts the present folder there
    modules = set(sys.modules)
    yield tmp_path / "repository"
    for name in set(sys.modules) - modules:
        if name.partition(".")[0] in ("scene", "gaussian_renderer", "diff_gaussian_rasterization"):
            del sys.modules[name]
