"""Both engines in turn, and the choice of the user afterwards."""

import os

import pytest
import torch

from reference_trainer.render import describe_engine
from reference_trainer.render.engine import engines_on, using_engine


@pytest.mark.parametrize("chosen", [None, "auto", "torch"])
@pytest.mark.parametrize("drawing", ["numba", "torch"])
def test_what_was_chosen_is_chosen_again(chosen, drawing, monkeypatch):
    if chosen is None:
        monkeypatch.delenv("CA_REG_ENGINE", raising=False)
    else:
        monkeypatch.setenv("CA_REG_ENGINE", chosen)

    def interrupted():
        with using_engine(drawing):
            assert describe_engine("cpu").startswith(drawing)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.environ.get("CA_REG_ENGINE") == chosen


def test_an_engine_that_is_not_there_changes_nothing(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "torch")
    with pytest.raises(ValueError, match="no engine 'lasers'"), using_engine("lasers"):
        pass
    assert os.environ["CA_REG_ENGINE"] == "torch"


def test_loops_draw_on_a_cpu_alone():
    assert engines_on(torch.device("cpu")) == ("numba", "torch")
    assert engines_on(torch.device("cuda")) == ("torch",)
