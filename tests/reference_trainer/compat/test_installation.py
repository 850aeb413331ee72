"""Installing and removing the stand-ins, and a repository in the INRIA style that trains with them."""

import runpy
import sys
from types import ModuleType

import pytest
import torch
from oracles import random_scene

from reference_trainer.compat import stand_in

NAMES = ("diff_gaussian_rasterization", "simple_knn", "simple_knn._C", "fused_ssim")
NAMES += ("gridencoder", "shencoder", "freqencoder")

RENDERER = """
import math
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

def render(view, model, background):
    screen = torch.zeros_like(model["xyz"], requires_grad=True, device="cuda") + 0
    screen.retain_grad()
    settings = GaussianRasterizationSettings(
        image_height=view["height"], image_width=view["width"], tanfovx=view["tanfovx"], tanfovy=view["tanfovy"],
        bg=background, scale_modifier=1.0, viewmatrix=view["view"], projmatrix=view["full"], sh_degree=0,
        campos=view["center"], prefiltered=False, debug=False)
    rasterizer = GaussianRasterizer(raster_settings=settings)
    image, radii = rasterizer(
        means3D=model["xyz"], means2D=screen, shs=None, colors_precomp=torch.sigmoid(model["color"]),
        opacities=torch.sigmoid(model["opacity"]), scales=torch.exp(model["scaling"]),
        rotations=torch.nn.functional.normalize(model["rotation"]), cov3D_precomp=None)
    return {"render": image, "viewspace_points": screen, "visibility_filter": radii > 0, "radii": radii}
"""

TRAIN = """
import torch
from gaussian_renderer import render
from simple_knn._C import distCUDA2

torch.cuda.set_device(torch.device("cuda:0"))
start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
points, target = POINTS.cuda(), TARGET.to("cuda")
n = len(points)
scaling = torch.log(torch.sqrt(torch.clamp_min(distCUDA2(points), 1e-7)))[..., None].repeat(1, 3)
rotation = torch.zeros((n, 4), device="cuda")
rotation[:, 0] = 1
model = {"xyz": points, "scaling": scaling, "rotation": rotation, "color": torch.zeros((n, 3), device="cuda"),
         "opacity": torch.zeros((n, 1), device="cuda")}
model = {name: torch.nn.Parameter(x.requires_grad_(True)) for name, x in model.items()}
optimizer = torch.optim.Adam(model.values(), lr=0.02)
losses, seen = [], torch.zeros(n, device="cuda")
for _ in range(12):
    start.record()
    out = render(VIEW, model, torch.zeros(3, device="cuda"))
    loss = (out["render"] - target).abs().mean()
    loss.backward()
    end.record()
    seen[out["visibility_filter"]] += out["viewspace_points"].grad[out["visibility_filter"], :2].norm(dim=-1)
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    losses.append(loss.item())
torch.cuda.synchronize()
torch.cuda.empty_cache()
"""


@pytest.fixture
def repository(tmp_path, settings_of, monkeypatch):
    """A repository in the INRIA style, which has never heard of a CPU."""
    (tmp_path / "gaussian_renderer").mkdir()
    (tmp_path / "gaussian_renderer" / "__init__.py").write_text(RENDERER)
    (tmp_path / "train.py").write_text(TRAIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("gaussian_renderer", None)


def _given(settings_of):
    """What the script's scene loader would load."""
    scene = random_scene(60, 24, 18, seed=2).to(torch.float32)
    settings = settings_of(scene.camera)
    view = {"height": 18, "width": 24, "tanfovx": settings.tanfovx, "tanfovy": settings.tanfovy}
    view |= {"view": settings.viewmatrix, "full": settings.projmatrix, "center": settings.campos}
    return {"POINTS": scene.means, "TARGET": torch.full((3, 18, 24), 0.6), "VIEW": view}


def test_an_unmodified_script_trains(repository, settings_of):
    before = dict(sys.modules)
    with stand_in(repository) as modules:
        assert modules == NAMES
        result = runpy.run_path(str(repository / "train.py"), init_globals=_given(settings_of), run_name="__main__")
    assert result["losses"][-1] < 0.7 * result["losses"][0]
    assert (result["seen"] > 0).any()
    assert not set(NAMES) & set(sys.modules)
    assert all(sys.modules.get(name) is module for name, module in before.items())


FORK = {
    "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer": """
try:
    from plane_rasterization import SparseGaussianAdam
except ImportError:
    pass
from plane_rasterization import PlaneRasterizationSettings as GaussianRasterizationSettings
from plane_rasterization import PlaneRasterizer as GaussianRasterizer
import subprocess
memory = subprocess.check_output("nvidia-smi -q -d Memory | grep -A4 GPU | grep Used", shell=True, text=True)
assert int(memory.split()[2]) >= 0
from helpers import Rasterizer
""",
    "debug=False)": "debug=False, filter_of_the_fork=0.1)",
    "image, radii = rasterizer(": "image, radii, planes, rendered_alpha = rasterizer(",
    "cov3D_precomp=None)": "poses_of_the_fork=screen[0])\n    assert rendered_alpha.shape == (1, 18, 24)",
}


def test_a_fork_with_other_names_settings_arguments_and_outputs_trains(repository, settings_of):
    path = repository / "gaussian_renderer" / "__init__.py"
    text = path.read_text()
    for before, after in FORK.items():
        assert before in text
        text = text.replace(before, after)
    path.write_text(text)
    (repository / "helpers.py").write_text("class Rasterizer:\n    own = True\n")

    def train():
        with stand_in(repository) as modules:
            assert modules == (NAMES[0], "plane_rasterization", *NAMES[1:])
            result = runpy.run_path(str(repository / "train.py"), init_globals=_given(settings_of), run_name="__main__")
            assert sys.modules.pop("helpers").Rasterizer.own
            return result

    with pytest.warns(UserWarning, match="of_the_fork, and ignores it") as warned:
        result = train()
    assert result["losses"][-1] < 0.7 * result["losses"][0]
    assert sum("of_the_fork" in str(w.message) for w in warned) == 2  # a setting and an argument, once each


def test_a_rasterizer_that_the_source_does_not_show_can_be_named(repository):
    with stand_in(repository, rasterizer="hidden_rasterization:HiddenRasterizer") as modules:
        from hidden_rasterization import HiddenRasterizer

        assert "hidden_rasterization" in modules
        assert issubclass(HiddenRasterizer, torch.nn.Module)


def test_everything_is_restored_after_an_error(repository):
    def fail():
        with stand_in(repository):
            raise KeyError("theirs")

    with pytest.raises(KeyError, match="theirs"):
        fail()
    assert not set(NAMES) & set(sys.modules)
    with stand_in(repository) as modules:
        assert set(modules) <= set(sys.modules)


def test_a_package_that_is_imported_already_is_left_alone(repository, monkeypatch):
    real = ModuleType("simple_knn")
    monkeypatch.setitem(sys.modules, "simple_knn", real)
    with pytest.raises(RuntimeError, match="simple_knn is imported already"), stand_in(repository):
        pass
    assert sys.modules["simple_knn"] is real
    assert "diff_gaussian_rasterization" not in sys.modules


def test_a_second_one_within_the_first_is_refused(repository):
    with stand_in(repository):
        import diff_gaussian_rasterization as module

        assert module is sys.modules["diff_gaussian_rasterization"]
        with pytest.raises(RuntimeError, match="end an earlier"), stand_in(repository):
            pass
    assert not set(NAMES) & set(sys.modules)


def test_the_modules_are_found_like_installed_ones(repository):
    from importlib.util import find_spec

    with stand_in(repository):
        assert all(find_spec(name).name == name for name in NAMES)


def test_extensions_within_packages_and_unused_compiled_code(repository):
    """As yindaheng98/gaussian-splatting builds its own, and hierarchical-3d-gaussians imports more than it calls."""
    text = (repository / "gaussian_renderer" / "__init__.py").read_text()
    within = text.replace("from diff_gaussian_rasterization", "from inner.diff_gaussian_rasterization")
    (repository / "gaussian_renderer" / "__init__.py").write_text(
        "from diff_gaussian_rasterization import _C\n"
        "from gaussian_tree._C import load\n"
        "from inner.simple_knn._C import distCUDA2 as neighbors\n"
        "from submodules.a.diff_gaussian_rasterization import GaussianRasterizer as Other\n" + within
    )
    (repository / "inner").mkdir()
    (repository / "inner" / "__init__.py").touch()
    (repository / "submodules" / "a").mkdir(parents=True)
    with stand_in(repository):
        import gaussian_renderer

        assert gaussian_renderer.neighbors is sys.modules["simple_knn._C"].distCUDA2
        assert {cls.__module__ for cls in (gaussian_renderer.GaussianRasterizer, gaussian_renderer.Other)} == {
            "inner.diff_gaussian_rasterization",
            "submodules.a.diff_gaussian_rasterization",
        }
        for use, name in (
            (lambda: gaussian_renderer._C.rasterize(1), "diff_gaussian_rasterization._C.rasterize"),
            (lambda: gaussian_renderer.load("file"), "gaussian_tree._C.load"),
        ):
            with pytest.raises(RuntimeError, match=f"{name} .*compiled code.*--cpu"):
                use()
    assert not {"gaussian_tree", "inner.simple_knn._C"} & set(sys.modules)
