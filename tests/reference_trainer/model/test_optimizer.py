"""Rows are independent in Adam: the surviving rows must move as if the others had never been there."""

import copy

import pytest
import torch

from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.optimizer import GaussianOptimizer

RATES = {"means": 1e-2, "log_scales": 5e-3, "quaternions": 1e-3, "opacity_logits": 0.05, "sh_dc": 2.5e-3,
         "sh_rest": 1.25e-4}  # fmt: skip


def some(n: int, seed: int = 0, degree: int = 1) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": (), "sh_dc": (1, 3)}
    shapes["sh_rest"] = ((degree + 1) ** 2 - 1, 3)
    return Gaussians(**{name: torch.randn(n, *shape, generator=g) for name, shape in shapes.items()})


def push(gaussians: Gaussians, ids: torch.Tensor, step: int) -> None:
    """Give every Gaussian a gradient that depends on its identity, the step and where it is."""
    loss = sum(
        (x * torch.sin(2.7 * step + 1.3 * ids.view(-1, *[1] * (x.ndim - 1))) + 0.5 * x.square()).sum()
        for _, x in gaussians.named()
    )
    loss.backward()


class Plain:
    """torch's own Adam, one loop, on rows that never change."""

    def __init__(self, gaussians: Gaussians, rates: dict[str, float] = RATES) -> None:
        self.gaussians = gaussians.map(lambda x: x.clone().requires_grad_())
        groups = [{"params": [x], "lr": rates[name]} for name, x in self.gaussians.named()]
        self.adam = torch.optim.Adam(groups, eps=1e-15, foreach=False, fused=False)

    def run(self, ids: torch.Tensor, steps: range) -> None:
        for step in steps:
            push(self.gaussians, ids, step)
            self.adam.step()
            self.adam.zero_grad()


def run(optimizer: GaussianOptimizer, ids: torch.Tensor, steps: range) -> None:
    for step in steps:
        push(optimizer.gaussians, ids, step)
        optimizer.step()


def assert_same(one: Gaussians, other: Gaussians) -> None:
    for (name, x), (_, y) in zip(one.named(), other.named(), strict=True):
        torch.testing.assert_close(x.detach(), y.detach(), rtol=1e-5, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize(
    "keep", [torch.tensor([True, False, True, True, False, True, True]), torch.tensor([6, 0, 3])], ids=["mask", "order"]
)
def test_survivors_move_as_if_they_had_been_alone(keep):
    ids = torch.arange(7.0)
    optimizer, plain = GaussianOptimizer(some(7), RATES), Plain(some(7)[keep])
    run(optimizer, ids, range(5))
    optimizer.select(keep)
    run(optimizer, ids[keep], range(5, 12))
    plain.run(ids[keep], range(12))
    assert_same(optimizer.gaussians, plain.gaussians)


def test_old_rows_do_not_feel_what_is_appended():
    ids = torch.arange(5.0)
    optimizer, plain = GaussianOptimizer(some(5), RATES), Plain(some(5))
    run(optimizer, ids, range(4))
    optimizer.append(some(3, seed=9))
    run(optimizer, torch.cat([ids, 10 + torch.arange(3.0)]), range(4, 9))
    plain.run(ids, range(9))
    assert_same(optimizer.gaussians[torch.arange(5)], plain.gaussians)


def test_appended_rows_begin_with_zero_moments_and_the_shared_step_count():
    """One step count per tensor, as in the INRIA code: a new row's first move is what Adam's formula gives there."""
    new, ids = some(3, seed=9), 10 + torch.arange(3.0)
    optimizer = GaussianOptimizer(some(5), RATES)
    run(optimizer, torch.arange(5.0), range(4))
    optimizer.append(new)
    for name, moments in optimizer.state_dict()["moments"].items():
        assert moments["step"].item() == 4
        for moment in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(moments[moment][5:], torch.zeros_like(moments[moment][5:])), name
            assert moments[moment][:5].abs().min() > 0, name
    run(optimizer, torch.cat([torch.arange(5.0), ids]), range(4, 5))
    by_hand = new.map(lambda x: x.clone().requires_grad_())
    push(by_hand, ids, 4)
    for (name, x), (_, moved) in zip(by_hand.named(), optimizer.gaussians.named(), strict=True):
        mean, square = 0.1 * x.grad / (1 - 0.9**5), 0.001 * x.grad.square() / (1 - 0.999**5)
        expected = x - RATES[name] * mean / square.sqrt()
        torch.testing.assert_close(moved[5:].detach(), expected.detach(), rtol=1e-5, atol=1e-6)


def test_many_changes_in_a_row():
    """Random cuts and joins: every row that is there in the end has the history of its own."""
    g = torch.Generator().manual_seed(3)
    optimizer, ids, step = GaussianOptimizer(some(12), RATES), torch.arange(12.0), 0
    for _ in range(5):
        run(optimizer, ids, range(step, step + 3))
        step += 3
        keep = torch.rand(len(ids), generator=g) < 0.85
        optimizer.select(keep)
        optimizer.append(some(2, seed=step))
        ids = torch.cat([ids[keep], 100.0 + step + torch.arange(2.0)])
    run(optimizer, ids, range(step, step + 3))
    old = ids < 12
    assert 2 <= int(old.sum()) < 12
    plain = Plain(some(12)[ids[old].long()])
    plain.run(ids[old], range(step + 3))
    assert_same(optimizer.gaussians[old], plain.gaussians)


def test_cuts_and_joins_before_the_first_step():
    keep = torch.tensor([1, 3])
    optimizer, plain = GaussianOptimizer(some(4), RATES), Plain(some(4)[keep])
    optimizer.select(keep)
    optimizer.append(some(1, seed=2))
    run(optimizer, torch.tensor([1.0, 3.0, 50.0]), range(4))
    plain.run(keep.float(), range(4))
    assert_same(optimizer.gaussians[torch.arange(2)], plain.gaussians)


def test_the_start_is_copied_and_gradients_are_cleared():
    start = some(4)
    before = start.means.clone()
    optimizer = GaussianOptimizer(start, RATES)
    run(optimizer, torch.arange(4.0), range(1))
    assert torch.equal(start.means, before)
    assert all(x.grad is None and x.is_leaf and x.requires_grad for _, x in optimizer.gaussians.named())


def test_the_rate_of_the_means_alone_changes():
    optimizer = GaussianOptimizer(some(4), RATES)
    before = optimizer.gaussians.map(lambda x: x.detach().clone())
    optimizer.set_means_rate(0.0)
    run(optimizer, torch.arange(4.0), range(1))
    assert torch.equal(optimizer.gaussians.means, before.means)
    # The first step of Adam has the length of the rate.
    moved = (optimizer.gaussians.sh_rest - before.sh_rest).detach().abs()
    torch.testing.assert_close(moved, torch.full_like(moved, RATES["sh_rest"]), rtol=2e-2, atol=0)


@pytest.mark.parametrize("names", [(), ("opacity_logits",), ("means", "sh_dc")])
def test_what_is_overwritten_keeps_its_state_until_it_is_forgotten(names):
    optimizer = GaussianOptimizer(some(4), RATES)
    run(optimizer, torch.arange(4.0), range(3))
    old = optimizer.state_dict()
    optimizer.set_opacity_logits(torch.tensor([0.0, 1.0, 2.0, 3.0]))
    if names:
        optimizer.forget(slice(None), *names)
    new = optimizer.state_dict()
    assert new["gaussians"]["opacity_logits"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert optimizer.gaussians.opacity_logits.requires_grad
    for name, moments in new["moments"].items():
        for moment in ("exp_avg", "exp_avg_sq"):
            expected = torch.zeros_like(moments[moment]) if name in names else old["moments"][name][moment]
            assert torch.equal(moments[moment], expected), name


def test_overwriting_before_the_first_step_needs_no_state():
    optimizer = GaussianOptimizer(some(2), RATES)
    optimizer.set_opacity_logits(torch.zeros(2))
    optimizer.forget(slice(None), "opacity_logits")
    assert optimizer.gaussians.opacity_logits.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("steps", [0, 4])
def test_state_round_trip_continues_bit_for_bit(steps):
    ids = torch.arange(5.0)
    straight = GaussianOptimizer(some(5), RATES)
    run(straight, ids, range(steps))
    state = straight.state_dict()
    frozen = copy.deepcopy(state)
    restored = GaussianOptimizer(some(2, seed=8), RATES)  # another number of Gaussians
    restored.load_state_dict(state)
    for optimizer in (straight, restored):
        run(optimizer, ids, range(steps, steps + 4))
    for (_, x), (_, y) in zip(straight.gaussians.named(), restored.gaussians.named(), strict=True):
        assert torch.equal(x, y)
    for name, x in state["gaussians"].items():  # what was handed out is a copy
        assert torch.equal(x, frozen["gaussians"][name])


def test_a_model_without_higher_bands():
    optimizer = GaussianOptimizer(some(3, degree=0), RATES)
    run(optimizer, torch.arange(3.0), range(2))
    optimizer.select(torch.tensor([2]))
    run(optimizer, torch.tensor([2.0]), range(2, 4))
    assert optimizer.gaussians.sh_rest.shape == (1, 0, 3)


def test_a_tensor_that_the_kernel_cannot_count_is_refused():
    pytest.importorskip("triton")
    from reference_trainer.model._adam_triton import adam_step

    x = torch.zeros(1).expand(2**31)
    with pytest.raises(ValueError, match="fewer than 2\\^31 numbers, got 2147483648"):
        adam_step([(x, x, x, x, 0.1)], 1, (0.9, 0.999), 1e-15)


def test_a_parameter_whose_numbers_lie_in_another_order_in_memory():
    """As spherical harmonics do that come from a file channel by channel."""
    start, ids = some(4), torch.arange(4.0)
    turned = some(4)
    turned.sh_rest.set_(turned.sh_rest.mT.contiguous().mT)
    assert not turned.sh_rest.is_contiguous()
    optimizer, plain = GaussianOptimizer(turned, RATES), Plain(start)
    run(optimizer, ids, range(5))
    plain.run(ids, range(5))
    assert_same(optimizer.gaussians, plain.gaussians)


def test_what_got_no_gradient_stays_and_counts_no_step():
    optimizer, plain = GaussianOptimizer(some(3), RATES), Plain(some(3))
    for step in range(4):
        for one in (optimizer.gaussians, plain.gaussians):
            push(one, torch.arange(3.0), step)
            if step % 2:
                one.means.grad = None
        optimizer.step()
        plain.adam.step()
        plain.adam.zero_grad()
    assert_same(optimizer.gaussians, plain.gaussians)
    steps = {name: moments["step"].item() for name, moments in optimizer.state_dict()["moments"].items()}
    assert steps == {name: 2 if name == "means" else 4 for name in steps}


@pytest.mark.gpu
def test_on_a_card_it_moves_as_on_a_processor_and_goes_on_from_there():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    ids, plain = torch.arange(3000.0), Plain(some(3000, degree=3))
    optimizer = GaussianOptimizer(some(3000, degree=3).to("cuda"), RATES)
    run(optimizer, ids.cuda(), range(5))
    restored = GaussianOptimizer(some(3000, degree=3), RATES)
    state = optimizer.state_dict()
    restored.load_state_dict(
        {
            "gaussians": {name: x.cpu() for name, x in state["gaussians"].items()},
            "moments": {name: {key: x.cpu() for key, x in of.items()} for name, of in state["moments"].items()},
        }
    )
    run(restored, ids, range(5, 8))
    plain.run(ids, range(8))
    assert_same(restored.gaussians, plain.gaussians)
