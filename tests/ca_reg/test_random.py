"""Random numbers that are the same on every device."""

import numpy as np
import pytest
import torch
from oracles import split_mix
from stand_ins.card import counted_synchronizations

from ca_reg._random import PortableGenerator, draw_numbers


def test_the_reference_of_these_tests_gives_the_published_words():
    assert split_mix(1234567, 3) == [6457827717110365317, 3203168211198807973, 9817491932198370423]


@pytest.mark.parametrize("entropy", [(0,), (1,), (2,), (3, 1), (2**64, 5)])
def test_uniform_numbers_are_the_upper_24_bits_of_split_mix(entropy):
    word = int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])  # with and without the sign bit
    numbers = draw_numbers(torch.rand, 1000, PortableGenerator(*entropy), "cpu")
    assert numbers.dtype == torch.float32
    assert numbers.tolist() == [(x >> 40) / 2**24 for x in split_mix(word, 1000)]


def test_draws_continue_one_sequence():
    whole, parts = PortableGenerator(3, 1), PortableGenerator(3, 1)
    expected = draw_numbers(torch.rand, 12, whole, "cpu")
    assert torch.equal(torch.cat([draw_numbers(torch.rand, n, parts, "cpu") for n in (5, 0, 7)]), expected)
    assert not torch.equal(draw_numbers(torch.rand, 12, PortableGenerator(1, 3), "cpu"), expected)


def test_normal_numbers_are_normal():
    # Kolmogorov and Smirnov's distance between 100,000 numbers and the normal distribution; above 0.0062 once in 1,000.
    numbers = draw_numbers(torch.randn, 100_000, PortableGenerator(0), "cpu").double().sort().values
    distance = (torch.special.ndtr(numbers) - torch.arange(0.5, 100_000, dtype=torch.float64) / 100_000).abs().max()
    assert distance < 0.0062


@pytest.mark.parametrize("sample", [torch.rand, torch.randn])
def test_numbers_are_those_of_the_processor_and_computed_on_the_card(card, sample):
    with counted_synchronizations() as waits:
        numbers = draw_numbers(sample, 1000, PortableGenerator(0), card)
    assert numbers.device.type == card.type
    assert not waits
    torch.testing.assert_close(numbers.cpu(), draw_numbers(sample, 1000, PortableGenerator(0), "cpu"))
    # The meta device has no numbers that could be copied from or to it.
    assert draw_numbers(sample, 1000, PortableGenerator(0), "meta").device.type == "meta"


def test_numbers_of_another_function_are_refused():
    """They had been normal."""
    with pytest.raises(ValueError, match=r"torch\.rand or"):
        draw_numbers(lambda *size, **where: 9 + torch.rand(*size, **where), 3, PortableGenerator(0), "cpu")


def test_own_draws_from_it_are_those_of_a_generator_on_the_cpu():
    draws = [torch.rand(3, generator=PortableGenerator(seed)) for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
