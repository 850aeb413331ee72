"""What the tests of the INRIA hook share."""

import importlib
import sys
from types import ModuleType

import pytest
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
