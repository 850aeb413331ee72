"""Which engine draws."""

import pytest
import torch
from oracles import random_scene

from reference_trainer.render import describe_engine, render, use_engine

pytest.importorskip("numba")


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "auto")


@pytest.mark.parametrize(
    ("chosen", "dtype", "name"),
    [
        ("auto", torch.float32, "loops"),
        ("loops", torch.float32, "loops"),
        ("torch", torch.float32, "torch"),
        ("auto", torch.float64, "torch"),
        ("loops", torch.float64, "torch"),
        ("auto", torch.bfloat16, "loops"),  # is drawn in float32
    ],
)
def test_loops_draw_float32_on_a_processor(chosen, dtype, name):
    use_engine(chosen)
    scene = random_scene(3, 9, 7, seed=1).to(dtype)
    camera = scene.camera.to(dtype=torch.float64)
    assert render(*scene[:4], camera, colors=scene.colors).splats.engine.name == name


def test_the_line_that_says_which():
    threads = torch.get_num_threads()
    assert describe_engine("cpu").startswith("loops (numba ")
    assert describe_engine("cpu").endswith(f", {threads} thread{'s' * (threads > 1)})")
    assert describe_engine("cuda").split()[0] in ("triton", "torch")  # also where there is no card, before a sweep
    use_engine("torch")
    assert describe_engine("cpu") == "torch"


def test_an_engine_that_does_not_exist(monkeypatch):
    with pytest.raises(ValueError, match="there is no engine 'metal'; choose one of auto, torch, loops"):
        use_engine("metal")
    monkeypatch.setenv("CA_REG_ENGINE", "metal")
    with pytest.raises(ValueError, match="CA_REG_ENGINE names the engine 'metal'"):
        describe_engine("cpu")
