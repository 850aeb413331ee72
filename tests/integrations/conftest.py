"""What the tests of the INRIA hook, of the launcher and of the gsplat adapter share."""

import importlib
import sys
import textwrap
from types import ModuleType

import pytest
import torch
from launched import FILES
from oracles import random_scene
from pages import ROOT, blocks
from stand_ins.gsplat import intrinsics
from stand_ins.inria import Model, make_rasterizer
from torch import nn

WIDTH, HEIGHT = 24, 16


@pytest.fixture
def cameras():
    """Two views of one scene, as gsplat takes them."""
    camera = random_scene(60, WIDTH, HEIGHT, seed=3).camera
    poses = torch.stack([camera.world_to_camera, camera.world_to_camera]).float()
    poses[1, 0, 3] += 0.4
    return {"viewmats": poses, "Ks": intrinsics(camera).float().expand(2, 3, 3), "width": WIDTH, "height": HEIGHT}


@pytest.fixture
def params():
    """Raw parameters by gsplat's names."""
    scene = random_scene(60, WIDTH, HEIGHT, seed=3).to(torch.float32)
    raw = {
        "means": scene.means,
        "quats": scene.quaternions,
        "scales": scene.scales.log(),
        "opacities": torch.logit(scene.opacities),
        "colors": scene.colors,
    }
    return nn.ParameterDict({name: nn.Parameter(x.clone()) for name, x in raw.items()})


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
