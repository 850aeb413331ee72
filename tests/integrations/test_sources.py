"""What the launcher reads of a code base before it runs: imports, rasterizers, models; a fork's are found."""

import json
import sys
import textwrap

import pytest

from ca_reg.integrations._scripts import Sources, read_folder, read_script
from ca_reg.integrations.run import main


def test_what_a_script_imports_is_read_also_through_the_files_beside_it(repository):
    (repository / "scene" / "views.py").write_text("from .. import gsplat\nfrom . import others, views\n")
    (repository / "scene" / "others.py").write_text("def late():\n    import far.away as near\n")
    (repository / "broken.py").write_text("import (\n")
    (repository / "other.py").write_text("import numpy.linalg, broken\nfrom scene import views\n")
    expected = {"numpy", "broken", "scene", "stand_ins", "far"}
    assert read_script(repository / "other.py").packages == expected
    assert "diff_gaussian_rasterization" in read_script(repository / "train.py").packages
    assert read_script("nowhere.train").packages == {"nowhere"}


def test_a_package_is_read_from_its_main_module_on(repository, monkeypatch):
    (repository / "scene" / "__main__.py").write_text("from . import train\n")
    (repository / "scene" / "train.py").write_text("from their_rasterizer import GaussianRasterizer\n")
    monkeypatch.chdir(repository)
    assert read_script("scene").classes == read_script("scene.train").classes == ["their_rasterizer:GaussianRasterizer"]


@pytest.mark.parametrize("reaches_up", [False, True])
def test_a_script_that_reaches_above_its_folder_is_read_with_what_lies_there(repository, reaches_up):
    script = repository / "scripts" / "train.py"
    script.parent.mkdir()
    script.write_text(reaches_up * "import sys; sys.path.append('..')\n" + "import scene.gaussian_model, train\n")
    sources = read_script(script)
    assert sources.root == (repository if reaches_up else script.parent).resolve()
    assert sources.models == ["scene.gaussian_model:GaussianModel"] * reaches_up
    assert ("diff_gaussian_rasterization" in sources.packages) == reaches_up


def test_a_package_that_is_built_on_another_needs_it():
    """torchmetrics requires torch, and tells so in what is installed with it."""
    assert Sources({"torchmetrics.image", "nowhere"}).need("torch")
    assert Sources({"gsplat"}).need("gsplat")
    assert not Sources({"torchmetrics"}).need("gsplat")
    assert not Sources({"ca_reg"}).need("gsplat")  # an extra


FORK = {
    "surfel_rasterization.py": """
        from stand_ins.inria import make_rasterizer

        SurfelRasterizer = make_rasterizer()
        SurfelRasterizationSettings = None
    """,
    "points/field.py": """
        from stand_ins.inria import Model

        class Base(Model):
            def update_learning_rate(self, iteration):
                self.rate = 1e-3

        class Points(Base):
            def update_learning_rate(self, iteration):
                super().update_learning_rate(iteration)
    """,
    "fork.py": """
        import sys
        import torch
        from points.field import Points
        from stand_ins.inria import make_render
        sys.path.append("packages")
        from surfel_rasterization import SurfelRasterizer

        points, render = Points(), make_render(SurfelRasterizer)
        for iteration in range(1, 5):
            {update}
            package = render(points.camera, points, None, torch.zeros(3))
            package["render"].sum().backward()
            with torch.no_grad():
                points._opacity.sub_(0.01)
    """,
}


@pytest.mark.parametrize("update", ["points.update_learning_rate(iteration)", "pass"])
@pytest.mark.parametrize("found", ["in the source", "by its name"])
def test_rasterizer_model_and_steps_of_a_fork_are_found(repository, tmp_path, capsys, monkeypatch, update, found):
    for name, text in FORK.items():
        path = repository / ("packages" if "raster" in name else "") / name
        path.parent.mkdir(exist_ok=True)
        text = text.replace("{update}", update)
        if update == "pass":
            text = text.replace("update_learning_rate", "adapt")
        path.write_text(textwrap.dedent(text))
    options = ["--dropout", 0.5, "--report", tmp_path / "report.json"]
    if found == "by its name":
        path = repository / "fork.py"
        path.write_text(path.read_text().replace("from surfel_rasterization import SurfelRasterizer",
            "SurfelRasterizer = __import__('surfel_rasterization').SurfelRasterizer"))  # fmt: skip
        options += ["--rasterizer", "surfel_rasterization:SurfelRasterizer"]
    monkeypatch.chdir(repository)
    main([str(x) for x in [*options, repository / "fork.py"]])
    renders = json.loads((tmp_path / "report.json").read_text())["renders"]
    assert (renders["regularized"], renders["first_step"], renders["last_step"]) == (4, 1, 4)
    for name in ("surfel_rasterization", "points.field", "points"):
        sys.modules.pop(name, None)


def test_the_sources_of_extensions_and_hidden_folders_are_not_read(repository):
    line = "from {} import GaussianRasterizer, PlaneRasterizationSettings as S, rasterize\n"
    for folder in ("submodules/a", ".git", "tools", "diff_local"):
        (repository / folder).mkdir(parents=True)
        (repository / folder / "x.py").write_text(
            line.format("diff_" + folder.rpartition("/")[2].strip(".").removeprefix("diff_"))
        )
    (repository / "tools" / "y.py").write_text("from diff_local import GaussianRasterizer\nimport (\n")
    (repository / "diff_local" / "z.py").write_text("from diff_local import OwnRasterizer\n")
    assert read_folder(repository).rasterizers == {"diff_tools": {"GaussianRasterizer", "PlaneRasterizationSettings"}}
    (repository / "moved.py").symlink_to(repository / "elsewhere.py")
    (repository / "folder.py").mkdir()
    assert read_folder(repository).classes == ["diff_tools:GaussianRasterizer"]
    (repository / "diff_local" / "setup.py").touch()  # an extension that is installed from there
    assert set(read_folder(repository).rasterizers) == {"diff_tools", "diff_local"}
    assert read_folder(repository).models == ["scene.gaussian_model:GaussianModel"]


def test_a_rasterizer_is_also_found_as_an_attribute_of_its_module(repository):
    (repository / "dotted.py").write_text(
        "import diff_first, far.diff_second, diff_third as r, scene, torch\n"
        "diff_first.GaussianRasterizer(diff_first.GaussianRasterizationSettings(scene.GaussianRasterizer))\n"
        "def late():\n    far.diff_second.GaussianRasterizer(torch.Tensor)\n    r.Own.render(r.SurfelRasterizer)\n"
    )
    classes = ["diff_first:GaussianRasterizer", "far.diff_second:GaussianRasterizer", "diff_third:SurfelRasterizer"]
    found = read_script(repository / "dotted.py")
    assert sorted(found.classes) == sorted(classes)
    assert found.rasterizers["diff_first"] == {"GaussianRasterizer", "GaussianRasterizationSettings"}


def test_rasterizers_of_meshes_are_left_alone(repository):
    """As SuGaR has them, and avatars that gsplat renders."""
    line = "from pytorch3d.renderer.mesh import MeshRasterizer, RasterizationSettings\n"
    (repository / "avatar.py").write_text(line + "import gsplat, pytorch3d.renderer as p\np.PointsRasterizer()\n")
    assert read_script(repository / "avatar.py").rasterizers == {}


def test_a_gsplat_beside_the_script_does_not_make_it_one_of_the_inria_family(repository):
    """As beside the trainers in its repository: it wraps their rasterizers for comparisons."""
    (repository / "gsplat").mkdir()
    (repository / "gsplat" / "__init__.py").write_text("from .rendering import rasterization\n")
    (repository / "gsplat" / "rendering.py").write_text("from diff_surfel import GaussianRasterizer\n")
    (repository / "trainer.py").write_text("from gsplat.rendering import rasterization\n")
    sources = read_script(repository / "trainer.py")
    assert (sources.packages, sources.classes) == ({"gsplat"}, [])


def test_rasterizers_within_packages_are_extensions_if_they_are_compiled(repository):
    """Under a dotted name, with their Python half in the repository (RAIN-GS) or built into its package."""
    halves = {"from ..setup import _C": "a", "from . import _C": "b", "import torch": "own"}
    for half, name in halves.items():
        folder = repository / "packages" / name / "raster"
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(f"{half}\nclass GaussianRasterizer: ...\n")
    (repository / "scene" / "late.py").write_text("from .built.raster import GaussianRasterizer\n")
    lines = [f"from packages.{name}.raster import GaussianRasterizer\n" for name in halves.values()]
    (repository / "tools.py").write_text("".join(lines))
    found = read_folder(repository).rasterizers
    assert set(found) == {"packages.a.raster", "packages.b.raster", "scene.built.raster"}


def test_a_class_of_the_main_program_is_no_model(repository):
    """No import shows it before it trains: changes of the parameters tell its steps."""
    text = "class Model:\n    def update_learning_rate(self, iteration):\n        pass\n"
    (repository / "single.py").write_text(text)
    (repository / "other.py").write_text("import single\n")
    assert read_script(repository / "single.py").models == []
    assert read_script(repository / "other.py").models == ["single:Model"]


def test_a_method_without_an_argument_does_not_tell_the_steps(repository):
    (repository / "trainer.py").write_text(
        "class Trainer:\n    def update_learning_rate(self):\n        pass\n"
        "class Model:\n    def update_learning_rate(self, iteration):\n        pass\n"
    )
    assert read_folder(repository).models == ["scene.gaussian_model:GaussianModel", "trainer:Model"]
