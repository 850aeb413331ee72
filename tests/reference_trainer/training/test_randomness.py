from itertools import product

import torch

from reference_trainer.training.randomness import stream, view_order


def test_streams_repeat_and_differ_in_seed_step_and_purpose():
    keys = list(product((0, 1), (0, 1, 256), ("dropout", "noise", "split")))
    draws = [tuple(torch.rand(4, generator=stream(*key)).tolist()) for key in keys]
    assert draws == [tuple(torch.rand(4, generator=stream(*key)).tolist()) for key in keys]
    assert len(set(draws)) == len(keys)


def test_large_seeds_are_not_cut():
    seeds = [7, 2**32 + 7, 2**63 + 7]
    assert len({torch.rand(4, generator=stream(seed, 0, "a")).sum().item() for seed in seeds}) == 3


def test_neighboring_streams_are_independent():
    """Masks of neighboring steps overlap as chance has it.

    The share of 200 x 500 pairs that agree has mean 1/2 and standard deviation 0.0016; 5 of them: false alarm 6e-7.
    """
    masks = torch.stack([torch.rand(500, generator=stream(0, step, "dropout")) < 0.5 for step in range(201)])
    agree = (masks[1:] == masks[:-1]).double().mean().item()
    assert abs(agree - 0.5) < 5 * 0.5 / (200 * 500) ** 0.5


def test_the_global_generator_is_untouched():
    before = torch.get_rng_state()
    torch.rand(3, generator=stream(0, 0, "dropout"))
    view_order(0, 5, 3)
    assert torch.equal(torch.get_rng_state(), before)


def test_every_epoch_sees_every_view_in_an_order_of_its_own():
    epochs = [tuple(view_order(3, 5 * epoch + i, 5) for i in range(5)) for epoch in range(40)]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4] for epoch in epochs)
    # 40 orders of 120: fewer than 20 different ones is beyond any chance.
    assert len(set(epochs)) >= 20
    assert epochs != [tuple(view_order(4, 5 * epoch + i, 5) for i in range(5)) for epoch in range(40)]
