"""Installing and removing the hook of the INRIA family, and what a user has to write."""

import contextlib
import difflib
import importlib
import importlib.util
import io
import sys
from typing import NamedTuple

import pytest
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render
from torch import nn

from ca_reg import GaussianDropout
from ca_reg.integrations._calls import hide_dropped
from ca_reg.integrations.inria import RasterizerHook

BLACK = torch.zeros(3)


def test_the_classes_are_put_back_exactly(rasterizer, model_class):
    class Child(rasterizer):
        """Inherits forward."""

    forward, update = vars(rasterizer)["forward"], vars(model_class)["update_learning_rate"]
    finders = list(sys.meta_path)
    for cls in (rasterizer, Child):
        hook = RasterizerHook(GaussianDropout(0.2), rasterizer=cls)
        with contextlib.suppress(ZeroDivisionError), hook:
            assert vars(cls)["forward"] is not forward
            assert vars(model_class)["update_learning_rate"] is not update
            raise ZeroDivisionError
        assert vars(rasterizer)["forward"] is forward
        assert "forward" not in vars(Child)
        assert vars(model_class)["update_learning_rate"] is update
        assert sys.meta_path == finders


def test_foreign_patches_are_respected(rasterizer):
    original = vars(rasterizer)["forward"]
    rasterizer.forward = lambda *args, **kwargs: original(*args, **kwargs)
    with pytest.raises(TypeError, match="means3D or opacities"):
        RasterizerHook(GaussianDropout(0.2), rasterizer=rasterizer).install()
    rasterizer.forward = original
    hook = RasterizerHook(GaussianDropout(0.2), rasterizer=rasterizer).install()
    ours = rasterizer.forward

    def foreign(self, *args, **kwargs):
        return ours(self, *args, **kwargs)

    rasterizer.forward = foreign
    with pytest.raises(RuntimeError, match="replaced again"):
        hook.uninstall()
    assert rasterizer.forward is foreign
    rasterizer.forward = ours
    hook.uninstall()
    assert rasterizer.forward is original


def test_two_hooks_are_refused(rasterizer):
    with RasterizerHook(GaussianDropout(0.2), rasterizer=rasterizer) as hook:
        with pytest.raises(RuntimeError, match="dropped twice"):
            RasterizerHook(GaussianDropout(0.2), rasterizer=rasterizer).install()
        with pytest.raises(RuntimeError, match="installed already"):
            hook.install()
    with pytest.raises(RuntimeError, match="not installed"):
        hook.uninstall()
    with hook:  # and it can be installed again
        pass


def test_hooks_of_two_rasterizers_wait_for_the_same_model(monkeypatch, tmp_path):
    """Both hooks watch for the import of scene.gaussian_model, and both follow its steps."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "gaussian_model.py").write_text("from stand_ins.inria import Model as GaussianModel\n")
    monkeypatch.syspath_prepend(tmp_path)
    classes = make_rasterizer(), make_rasterizer()
    first, second = (RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) for rasterizer in classes)
    with first, second:
        model = importlib.import_module("scene.gaussian_model").GaussianModel()
        model.update_learning_rate(5)
        for rasterizer in classes:
            make_render(rasterizer)(model.camera, model, PIPE, BLACK)
    assert [hook.tally.first_step for hook in (first, second)] == [5, 5]
    for name in ("scene", "scene.gaussian_model"):
        del sys.modules[name]


def test_installed_rasterizers_are_found_whenever_they_are_imported(monkeypatch, tmp_path):
    for name in ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs"):
        (tmp_path / f"{name}.py").write_text(
            "from stand_ins.inria import make_rasterizer\nGaussianRasterizer = make_rasterizer()\n"
        )
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    import diff_gaussian_rasterization as early

    with RasterizerHook(GaussianDropout(0.5)) as hook:
        assert "diff_gaussian_rasterization_abs" not in sys.modules
        import diff_gaussian_rasterization_abs as late

        for step, module in enumerate((early, late), 1):
            hook.step(step)
            model = Model()
            make_render(module.GaussianRasterizer)(model.camera, model, PIPE, BLACK)
    assert hook.tally.regularized == 2
    for name in ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs"):
        sys.modules.pop(name)


def test_without_a_rasterizer_the_first_call_says_what_to_do(monkeypatch):
    monkeypatch.delitem(sys.modules, "diff_gaussian_rasterization", raising=False)
    if any(importlib.util.find_spec(f"diff_gaussian_rasterization{suffix}") for suffix in ("", "_abs")):
        pytest.skip("a rasterizer is installed")
    with pytest.raises(ImportError, match=r"python -m ca_reg\.integrations\.run --cpu"):
        RasterizerHook(GaussianDropout(0.2)).install()


def test_arguments_are_checked(rasterizer):
    with pytest.raises(ValueError, match="scope"):
        RasterizerHook(GaussianDropout(0.2), scope="first")
    with pytest.raises(ValueError, match="empty"):
        RasterizerHook(nn.Sequential())
    with pytest.raises(ValueError, match=r"steps .*updates, parameters"):
        RasterizerHook(GaussianDropout(0.2), steps="renders")
    with pytest.raises(ValueError, match=r"patience .*at least 0"):
        RasterizerHook(GaussianDropout(0.2), patience=-1)
    with pytest.raises(TypeError, match=r"Linear .*argument generator"):
        RasterizerHook(nn.Sequential(GaussianDropout(0.2), nn.Linear(1, 1)))
    with pytest.raises(TypeError, match="module, got float"):
        RasterizerHook(0.2)


@pytest.mark.parametrize(
    "names",
    [
        ["image", "radii"],
        ["image", "radii", "weights"],  # AbsGS: item 2 is per Gaussian
        ["image", "radii", "plane"],
        ["image", "plane", "plane", "radii"],
        ["image", "radii 2d"],
        ["image", "radii", "used"],  # 3dgs-mcmc
        ["image", "radii", "counts", "weights", "radii", "flags", "lists"],  # as long as those of taming-3dgs
    ],
)
def test_all_that_is_counted_per_gaussian_is_hidden(names):
    n = 4  # as many Gaussians as rows of the picture
    members = {
        "image": torch.ones(3, n, 5),
        "radii": torch.tensor([7, 5, 3, 2], dtype=torch.int32),
        "radii 2d": torch.ones(n, 2, dtype=torch.int32),
        "used": torch.ones(n, dtype=torch.int32),
        "counts": torch.ones(n, 1, dtype=torch.int64),
        "flags": torch.ones(n, dtype=torch.bool),
        "weights": torch.ones(n),
        "plane": torch.ones(1, n, 5),
        "lists": torch.ones(9, dtype=torch.int32),
    }
    counted = {"radii", "radii 2d", "used", "counts", "flags"}
    keep = torch.tensor([True, False, True, False])
    given = tuple(members[name] for name in names)
    for name, before, after in zip(names, given, hide_dropped(given, keep), strict=True):
        assert after.dtype == before.dtype
        assert torch.equal(after[keep] if name in counted else after, before[keep] if name in counted else before)
        assert not (name in counted and after[~keep].any())


def test_a_named_tuple_stays_one():
    class Rendered(NamedTuple):
        color: torch.Tensor
        radii: torch.Tensor

    given = Rendered(torch.zeros(3, 4, 5), torch.ones(2, dtype=torch.int32))
    assert hide_dropped(given, torch.tensor([False, True])).radii.tolist() == [0, 1]


def test_a_tuple_without_radii_is_an_error():
    keep = torch.ones(7, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"integer .*shape \(7,\)"):
        hide_dropped((torch.zeros(3, 4, 5), torch.ones(7)), keep)
    with pytest.raises(TypeError, match="returned Tensor"):
        hide_dropped(torch.zeros(3, 4, 5), keep)


USER_FILE = """
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render

GaussianRasterizer = make_rasterizer()
render = make_render(GaussianRasterizer)
model = Model()
optimizer = torch.optim.Adam(model.parameters())

for iteration in range(1, 4):
    package = render(model.camera, model, PIPE, torch.zeros(3))
    package["render"].sum().backward()
    optimizer.step()
    print((package["radii"] > 0).sum().item())
"""


def test_a_users_file_needs_three_lines():
    lines = USER_FILE.splitlines()
    at = lines.index("model = Model()")
    loop = lines.index("for iteration in range(1, 4):")
    edited = [
        "from ca_reg import GaussianDropout; from ca_reg.integrations.inria import RasterizerHook",
        *lines[:at],
        "hook = RasterizerHook(GaussianDropout(0.5), rasterizer=GaussianRasterizer).install()",
        *lines[at : loop + 1],
        "    hook.step(iteration)",
        *lines[loop + 1 :],
    ]
    changes = [line for line in difflib.ndiff(lines, edited) if line[0] in "+-"]
    assert len(changes) == 3
    assert all(line.startswith("+") for line in changes)

    def run(source):
        printed, namespace = io.StringIO(), {}
        with contextlib.redirect_stdout(printed):
            exec("\n".join(source), namespace)
        if "hook" in namespace:
            namespace["hook"].uninstall()
        return [int(line) for line in printed.getvalue().split()]

    seen, regularized = run(lines), run(edited)
    assert all(a < 0.8 * b for a, b in zip(regularized, seen, strict=True))
