import pytest
import torch

from reference_trainer.render.running_sums import running_sums_
from reference_trainer.training.determinism import deterministic


@pytest.mark.parametrize("length", [0, 1, 2, 7, 64, 129])
@pytest.mark.parametrize("repeatable", [False, True])
def test_sums_up_to_every_place(length, repeatable, device):
    x = torch.rand(3, 5, length, dtype=torch.float64, generator=torch.Generator().manual_seed(length))
    expected = torch.stack([x[..., : i + 1].sum(-1) for i in range(length)], -1) if length else x
    found = x.to(device, copy=True)
    with deterministic(device if repeatable else "cpu"):
        assert running_sums_(found) is found
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-14, atol=0.0)


def test_only_whole_copies_are_added_where_sums_shall_repeat_themselves(card):
    """The card refuses `cumsum` there, as CUDA does; a part of a larger tensor is replaced, and nothing beside it."""
    x = torch.ones(2, 9, device=card)
    with deterministic(card):
        running_sums_(x[:, 2:7])
    assert x.tolist() == [[1, 1, 1, 2, 3, 4, 5, 1, 1]] * 2
