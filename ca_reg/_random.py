"""Random numbers: draws from an optional generator, and generators seeded by several integers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

_WORD = (1 << 64) - 1
_STEP, _ROUNDS, _LAST = 0x9E3779B97F4A7C15, ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)), 31  # of SplitMix64


def draw_numbers(
    sample: Callable[..., Tensor], n: int, generator: torch.Generator | None, device: torch.device | str | None
) -> Tensor:
    """Return n float32 numbers of ``torch.rand`` or ``torch.randn``, drawn on the generator's device if one is given.

    A generator need not be on the device of the Gaussians: one on the CPU draws the same numbers for every device, and
    they are copied there; a :class:`PortableGenerator` computes them there. Without a generator, the global one of
    ``device`` is taken.

    Raises:
        ValueError: if a score draws with another function, whose numbers it cannot compute.
        RuntimeError: if a generator is used during a backward pass, where a recomputed draw would differ.

    Example:
        >>> draw_numbers(torch.rand, 3, torch.Generator().manual_seed(0), "cpu")
        tensor([0.4963, 0.7682, 0.0885])
    """
    if generator is not None and torch._C._current_graph_task_id() != -1:
        raise RuntimeError(
            "a draw with generator= was repeated during backward(): torch.utils.checkpoint restores the global random "
            "state and no other, so the gradient would be that of another draw. Draw outside the checkpointed function "
            "and give it drawn=, or leave out generator."
        )
    if generator is None:  # not passed on: with it, a compiled graph could not draw for a number that changes
        return sample(n, dtype=torch.float32, device=device)
    if type(generator) is PortableGenerator:  # isinstance would ask torch's metaclass, which takes longer than a draw
        return generator.numbers(sample, n, device)
    x = sample(n, generator=generator, dtype=torch.float32, device=generator.device)
    return x if device is None else x.to(device)


class PortableGenerator(torch.Generator):
    """A generator whose numbers `draw_numbers` computes on the device that wants them.

    The draws of a score come from it, so that nothing is drawn on the CPU and copied to a card: masks are the same on
    every device, normal numbers equal to rounding. It counts: number i is a hash of i and the seed (SplitMix64: Steele,
    Lea and Flood, "Fast splittable pseudorandom number generators", 2014). For whoever calls
    ``torch.rand(generator=...)`` it is a generator on the CPU with the same seed.

    Args:
        entropy: non-negative integers, which together are the seed.

    Example:
        >>> generator = PortableGenerator(0, 7)
        >>> draw_numbers(torch.rand, 3, generator, "cpu")
        tensor([0.4847, 0.8635, 0.3176])
    """

    def __new__(cls, *entropy: int) -> PortableGenerator:
        return super().__new__(cls)  # without the integers, which torch would take for a device; on the CPU

    def __init__(self, *entropy: int) -> None:
        self._seed = _word(entropy)
        self._drawn = 0
        self.manual_seed(self._seed >> 1)

    def numbers(self, sample: Callable[..., Tensor], n: int, device: torch.device | str | None) -> Tensor:
        """Return the next n numbers of ``torch.rand`` or ``torch.randn``, float32."""
        if sample is not torch.rand and sample is not torch.randn:
            raise ValueError(f"sample must be torch.rand or torch.randn, got {sample!r}: transform what these return.")
        words = self._words(n, device)
        uniform = (words >> 40 & 0xFFFFFF).float() * 2**-24  # the upper 24 bits: what a float32 holds
        if sample is torch.rand:
            return uniform
        radius = (1 - uniform).log_().mul_(-2).sqrt_()  # Box and Muller; 1 - u is never 0
        return radius * (words & 0xFFFFFF).float().mul_(math.tau * 2**-24).cos_()

    def _words(self, n: int, device: torch.device | str | None) -> Tensor:
        """Return the next n words of 64 bits, int64, whose products and sums wrap around as the hash wants it."""
        x = torch.arange(self._drawn + 1, self._drawn + n + 1, device=device)
        self._drawn += n
        x.mul_(_signed(_STEP)).add_(_signed(self._seed))
        for shift, factor in _ROUNDS:
            x.bitwise_xor_(_upper(x, shift)).mul_(_signed(factor))
        return x.bitwise_xor_(_upper(x, _LAST))


def _upper(x: Tensor, shift: int) -> Tensor:
    """Return ``x >> shift`` of int64 as if it had no sign."""
    return x >> shift & ((1 << 64 - shift) - 1)


def _signed(word: int) -> int:
    return word - (word >> 63 << 64)


def split_mix(seed: int, i: int) -> int:
    """Return the i-th word of SplitMix64 with this seed, counted from 1.

    Example:
        >>> split_mix(1234567, 1)
        6457827717110365317
    """
    x = (seed + i * _STEP) & _WORD
    for shift, factor in _ROUNDS:
        x = ((x ^ x >> shift) * factor) & _WORD
    return x ^ x >> _LAST


def _word(entropy: tuple[int, ...]) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])


def seeded(*entropy: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator seeded by all of these non-negative integers."""
    return torch.Generator(device).manual_seed(_word(entropy) >> 1)
