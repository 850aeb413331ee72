import pytest
import torch

from reference_trainer.tensor_files import load_tensors, moved


def test_what_holds_itself_is_refused(tmp_path):
    endless = []
    endless.append(endless)
    torch.save({"x": endless}, tmp_path / "endless.pt")
    with pytest.raises(ValueError, match=r"endless\.pt .*list at two places"):
        load_tensors(tmp_path / "endless.pt")


def test_tensors_move_and_nothing_else_does(card):
    x = torch.arange(3.0)
    state = {"x": x, "deep": [{"y": x + 1, "name": "fern"}, None, 3]}
    there = moved(state, card)
    assert (there["x"].device.type, there["deep"][0]["y"].tolist()) == ("card", [1, 2, 3])
    assert there["deep"][1:] == [None, 3]
    back = moved(there, "cpu")
    assert torch.equal(back["x"], x)
    assert moved(state, "cpu")["x"] is x
