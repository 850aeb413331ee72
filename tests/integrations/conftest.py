"""What the tests of the INRIA hook share."""

import sys
from types import ModuleType

import pytest
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
