"""The pretended card computes what the processor computes, and refuses what CUDA refuses."""

import pytest
import torch
from stand_ins.card import counted_synchronizations, pretended_card

from reference_trainer.training.randomness import deterministic


def on(device, *shape):
    return torch.ones(*shape, device=device)


def test_numbers_and_gradients_are_those_of_the_processor(card):
    x = torch.linspace(-1, 1, 12).view(3, 4).requires_grad_()
    y = x.detach().to(card).requires_grad_()
    for z in (x, y):
        (z.exp() @ torch.arange(4.0, device=z.device) + torch.eye(3, device=z.device)[0]).square().sum().backward()
    assert (y.device.type, y.grad.device.type) == ("card", "card")
    assert torch.equal(y.grad.cpu(), x.grad)


def test_views_share_their_numbers(card):
    x = on(card, 4)
    x[1:3].zero_()
    torch.mul(x[:1], 5, out=x[3:])
    assert x.tolist() == [1, 0, 0, 5]


@pytest.mark.parametrize(
    "mix",
    [
        lambda x: x + torch.ones(2),
        lambda x: torch.ones(2).mul_(x),
        lambda x: torch.stack([x.sum(), torch.tensor(1.0)]),
        lambda x: torch.cat([x, torch.ones(2)]),
        lambda x: torch.ones(3)[x.long()],
        lambda x: x.index_add(0, torch.tensor([0]), x[:1]),
    ],
)
def test_devices_do_not_mix(card, mix):
    with pytest.raises(RuntimeError, match="the same device"):
        mix(on(card, 2))


def test_a_second_card_is_another_device(card):
    one, other = on(card, 3), on("card:1", 3)
    assert (other.device.index, (2 * other).device.index, other.new_tensor([1.0]).device.index) == (1, 1, 1)
    with pytest.raises(RuntimeError, match=r"found cards \[0, 1\]"):
        one + other
    assert (one + other.to(card)).tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    ("call", "refusal"),
    [
        (lambda x: x.int() @ x.int(), "addmm_cuda"),
        (lambda x: x.long()[None] @ x.long()[None], "addmm_cuda"),
        (lambda x: torch.linalg.eigvalsh(x.expand(40_000, 3, 3).contiguous()), "CUSOLVER"),
        (lambda x: torch.linalg.eigh(x.half()), "linalg_eigh_cuda"),
    ],
)
def test_what_has_no_kernel_is_refused(card, call, refusal):
    with pytest.raises(RuntimeError, match=refusal):
        call(torch.eye(3, device=card))


def test_eigenvalues_are_there_for_batches_that_cusolver_takes(card):
    assert torch.linalg.eigvalsh(torch.eye(3, device=card).expand(100, 3, 3).contiguous()).sum().item() == 300


@pytest.mark.parametrize(
    ("call", "waits"),
    [
        (lambda x: x.sum().item(), 1),
        (lambda x: bool(x.any()), 1),
        (lambda x: x.tolist(), 1),
        (lambda x: x.cpu(), 1),
        (lambda x: torch.ones(3).copy_(x), 1),
        (lambda x: x.to("cpu", non_blocking=True), 0),
        (lambda x: torch.ones(3).to(x.device), 1),
        (lambda x: torch.ones(3).to(x.device, non_blocking=True), 0),
        (lambda x: x.copy_(torch.ones(3)), 1),
        (lambda x: x.copy_(torch.ones(3), non_blocking=True), 0),
        (lambda x: torch.tensor([1.0], device=x.device), 1),
        (lambda x: x.__setitem__(0, 2.0), 0),
        (lambda x: x * torch.tensor(2.0), 0),
        (lambda x: torch.full((3,), 2.0, device=x.device), 0),
        (lambda x: x.to(torch.float64).copy_(x), 0),
        (lambda x: x.nonzero(), 1),
        (lambda x: x[x > 0], 1),
        (lambda x: x.unique(), 1),
        (lambda x: torch.equal(x, x), 1),
        (lambda x: x.masked_fill(x > 0, 0), 0),
        (lambda x: x.__setitem__(x > 0, 0), 0),
        (lambda x: (x * 2).where(x > 0, x).to(torch.float64).sum(), 0),
        (lambda x: x[torch.zeros(2, dtype=torch.long, device=x.device)], 0),
    ],
)
def test_waiting_for_the_card_is_counted(card, call, waits):
    x = on(card, 3)
    with counted_synchronizations() as found:
        call(x)
    assert found.total() == waits, found
    call(x)
    assert found.total() == waits


def test_what_cuda_takes_from_the_processor(card):
    x = on(card, 3)
    x[torch.tensor([1])] = 5.0
    x.copy_(x.cpu() + 1)
    assert (x * torch.tensor(2.0))[torch.tensor([0, 1])].tolist() == [4, 12]


def test_numpy_needs_the_processor(card):
    with pytest.raises(TypeError, match="can't convert"):
        on(card, 2).numpy()


def test_generators_have_a_device(card):
    assert torch.rand(3, device=card, generator=torch.Generator(card).manual_seed(0)).device.type == "card"
    with pytest.raises(RuntimeError, match=r"'card' generator .*'cpu'"):
        torch.rand(3, device=card, generator=torch.Generator())
    with pytest.raises(RuntimeError, match=r"'cpu' generator .*'card'"):
        torch.rand(3, generator=torch.Generator(card))


def test_without_the_card_it_is_gone(card):
    assert isinstance(torch.Generator(card), torch.Generator)
    with pretended_card():
        pass
    assert torch.Generator().device.type == "cpu"


def test_additions_come_in_any_order_unless_they_shall_repeat_themselves():
    """Nine fixed orders of a sum that has several results in float32."""
    terms = torch.tensor([1e8, 1.0, -1e8, 1.0, 3.0])

    def sums():
        found = set()
        for order in range(9):
            with pretended_card(order=order) as card:
                index = torch.zeros(5, dtype=torch.int64, device=card)
                found.add(torch.zeros(1, device=card).index_add_(0, index, terms.to(card)).item())
        return found

    assert len(sums()) > 1
    with deterministic("card"):
        assert len(sums()) == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda x: x.cumsum(0),
        lambda x: x.clone().cumsum_(0),
        lambda x: x.histc(),
        lambda x: x.median(0),
        lambda x: x.kthvalue(2),
        lambda x: torch.bincount(x.long(), weights=x),
    ],
)
def test_what_cannot_repeat_itself_is_refused_where_that_is_asked_for(card, call):
    call(on(card, 3))
    with deterministic(card), pytest.raises(RuntimeError, match="deterministic implementation"):
        call(on(card, 3))


def test_whole_numbers_always_repeat_themselves(card):
    with deterministic(card):
        assert torch.bincount(on(card, 3).long().cumsum(0)).tolist() == [0, 1, 1, 1]
        assert on(card, 3).median().item() == 1
