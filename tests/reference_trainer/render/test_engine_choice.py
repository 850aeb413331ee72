"""Both engines in turn, and the choice of the user afterwards."""

import os
from importlib.util import find_spec

import pytest
import torch

from reference_trainer.render import describe_engine
from reference_trainer.render.engine import drawn_by, engine_for, engines_on


@pytest.mark.parametrize("chosen", [None, "auto", "torch"])
@pytest.mark.parametrize("drawing", ["loops", "torch"])
def test_what_was_chosen_is_chosen_again(chosen, drawing, monkeypatch):
    if chosen is None:
        monkeypatch.delenv("CA_REG_ENGINE", raising=False)
    else:
        monkeypatch.setenv("CA_REG_ENGINE", chosen)

    def interrupted():
        with drawn_by(drawing):
            assert describe_engine("cpu").startswith(drawing)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.environ.get("CA_REG_ENGINE") == chosen


def test_an_engine_that_is_not_there_changes_nothing(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "torch")
    with pytest.raises(ValueError, match="no engine 'lasers'"), drawn_by("lasers"):
        pass
    assert os.environ["CA_REG_ENGINE"] == "torch"


def test_loops_draw_on_a_cpu_alone():
    assert engines_on(torch.device("cpu")) == ("loops", "torch")
    assert engines_on(torch.device("cuda")) == (("triton", "torch") if find_spec("triton") else ("torch",))


def test_triton_draws_float32_on_a_card_and_if_interpreted_on_a_cpu(monkeypatch):
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
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert engine_for(torch.device("cpu")).name == "triton"
    assert describe_engine("cpu").startswith("triton ")
    assert describe_engine("cpu").endswith("interpreted)")


def test_triton_that_is_missing_is_an_error_only_if_asked_for(monkeypatch):
    monkeypatch.setattr("reference_trainer.render.engine._triton_engine", lambda: None)
    assert engines_on(torch.device("cuda")) == ("torch",)
    with pytest.raises(ImportError, match="pip install triton"), drawn_by("triton"):
        pass
