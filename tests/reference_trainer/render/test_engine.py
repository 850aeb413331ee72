"""Which engine renders, and the choice of the user afterwards."""

import os
import shutil
import sys
from importlib.util import find_spec

import pytest
import torch
from oracles import random_scene

from reference_trainer.render import describe_engine, render, use_engine
from reference_trainer.render import engine as engine_module
from reference_trainer.render.engine import engine_for, engines_on, using_engine

pytest.importorskip("numba")


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "auto")
    monkeypatch.setenv("CC", "cc")  # a compiler, whatever this machine has


@pytest.fixture
def afresh():
    """Engines are looked for again, now and after the test."""
    engine_module._compiled_engine.cache_clear()
    yield
    engine_module._compiled_engine.cache_clear()


@pytest.mark.parametrize(
    ("chosen", "dtype", "name"),
    [
        ("auto", torch.float32, "numba"),
        ("numba", torch.float32, "numba"),
        ("torch", torch.float32, "torch"),
        ("auto", torch.float64, "torch"),
        ("numba", torch.float64, "torch"),
        ("auto", torch.bfloat16, "numba"),  # is rendered in float32
    ],
)
def test_numba_renders_float32_on_a_processor(chosen, dtype, name):
    use_engine(chosen)
    scene = random_scene(3, 9, 7, seed=1).to(dtype)
    camera = scene.camera.to(dtype=torch.float64)
    assert render(*scene[:4], camera, colors=scene.colors).splats.engine.name == name


def test_the_line_that_says_which():
    threads = torch.get_num_threads()
    assert describe_engine("cpu").startswith("numba (")
    assert describe_engine("cpu").endswith(f", {threads} thread{'s' * (threads > 1)})")
    assert describe_engine("cuda").split()[0] == (
        "triton" if find_spec("triton") else "torch"
    )  # also where there is no card, as before a sweep on other machines
    use_engine("torch")
    assert describe_engine("cpu") == "torch"


def test_the_line_of_a_triton_that_came_by_another_name(unnamed):
    """As with PyTorch for AMD's cards, for Windows, and every night: pytorch-triton-rocm, triton-windows."""
    triton = pytest.importorskip("triton")
    unnamed("triton")
    assert describe_engine("cuda") == f"triton ({triton.__version__})"


def test_the_line_of_a_card_that_another_machine_has(monkeypatch):
    """As before a sweep on a cluster, from a machine with one card."""

    def capability(device):
        raise AssertionError("Invalid device id")  # PyTorch's own words

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_capability", capability)
    assert describe_engine("cuda:1").split()[0] == ("triton" if find_spec("triton") else "torch")


@pytest.mark.parametrize("version", ["3.1.0", "3.3.1", "3.3.1+git5c1e5bb"])
def test_a_triton_that_compiles_no_tuples_is_as_good_as_none(version, afresh, monkeypatch):
    """As that of torch 2.5 to 2.7: said once, and refused by name."""
    monkeypatch.setattr(pytest.importorskip("triton"), "__version__", version)
    for name in [x for x in sys.modules if x.startswith("reference_trainer.render.triton")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.warns(UserWarning, match=r"need Triton 3\.4 or newer, which comes with torch 2\.8, got 3\.") as warned:
        assert describe_engine("cuda") == describe_engine("cuda") == "torch"
    assert len(warned) == 1
    assert engines_on(torch.device("cuda")) == ("torch",)
    with pytest.raises(ImportError, match=r"the engine triton needs Triton 3\.4"):
        use_engine("triton")


def test_triton_without_a_c_compiler_is_as_good_as_none(afresh, monkeypatch):
    pytest.importorskip("triton")
    monkeypatch.delenv("CC")
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.warns(UserWarning, match="needs a C compiler: install gcc or clang, or name one by CC"):
        assert describe_engine("cuda") == "torch"
    with pytest.raises(ImportError, match=r"the engine triton needs .* a C compiler"):
        use_engine("triton")
    engine_module._compiled_engine.cache_clear()
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/clang" if name == "clang" else None)
    assert describe_engine("cuda").startswith("triton")


def test_an_engine_that_does_not_exist(monkeypatch):
    with pytest.raises(ValueError, match=r"no engine 'metal'; .*torch, numba"):
        use_engine("metal")
    monkeypatch.setenv("CA_REG_ENGINE", "metal")
    with pytest.raises(ValueError, match=r"CA_REG_ENGINE .*'metal'"):
        describe_engine("cpu")


@pytest.mark.parametrize("chosen", [None, "auto", "torch"])
@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_what_was_chosen_is_chosen_again(chosen, engine, monkeypatch):
    if chosen is None:
        monkeypatch.delenv("CA_REG_ENGINE", raising=False)
    else:
        monkeypatch.setenv("CA_REG_ENGINE", chosen)

    def interrupted():
        with using_engine(engine):
            assert describe_engine("cpu").startswith(engine)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.environ.get("CA_REG_ENGINE") == chosen


def test_an_engine_that_is_not_there_changes_nothing(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "torch")
    with pytest.raises(ValueError, match="no engine 'lasers'"), using_engine("lasers"):
        pass
    assert os.environ["CA_REG_ENGINE"] == "torch"


def test_loops_render_on_a_cpu_alone(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    assert engines_on(torch.device("cpu")) == ("numba", "torch")
    kernels = ("triton",) if find_spec("triton") else ()
    assert engines_on(torch.device("cuda")) == (*kernels, "torch")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert engines_on(torch.device("cpu")) == (*kernels, "numba", "torch")


def test_triton_renders_float32_on_a_card_and_if_interpreted_on_a_cpu(monkeypatch):
    """Also where there is no card, as before a sweep on other machines."""
    pytest.importorskip("triton")
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    for chosen, device, dtype, name in [
        ("auto", "cuda", torch.float32, "triton"),
        ("auto", "cuda", torch.float64, "torch"),
        ("torch", "cuda", torch.float32, "torch"),
        ("triton", "cuda", torch.float32, "triton"),
        ("triton", "cpu", torch.float64, "torch"),
    ]:
        monkeypatch.setenv("CA_REG_ENGINE", chosen)
        assert engine_for(torch.device(device), dtype).name == name
    assert engine_for(torch.device("cpu")).name != "triton"  # compiled kernels cannot run there
    monkeypatch.setenv("CA_REG_ENGINE", "triton")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert engine_for(torch.device("cpu")).name == "triton"
    assert describe_engine("cpu").startswith("triton ")
    assert describe_engine("cpu").endswith("interpreted)")


def test_no_loop_is_compiled_again_for_tensors_that_lie_in_larger_ones():
    from reference_trainer.compiled.compiling import KERNELS

    use_engine("numba")
    scene = random_scene(40, 30, 20, seed=1).to(torch.float32)
    depths = scene.means @ scene.camera.world_to_camera[2, :3] + scene.camera.world_to_camera[2, 3]
    seen = [x[depths > 0.3].contiguous() for x in scene.tensors()]
    apart = [torch.stack([x, x], dim=-1)[..., 0] for x in seen]
    assert not any(x.is_contiguous() for x in apart)
    images, compiled = [], []
    for *tensors, colors in (seen, apart):
        leaves = [x.detach().requires_grad_() for x in tensors]
        image = render(*leaves, scene.camera, colors=colors).image
        image.sum().backward()
        images.append(image)
        compiled.append([len(kernel.signatures) for kernel in KERNELS])
    assert torch.equal(*images)
    assert compiled[0] == compiled[1]
