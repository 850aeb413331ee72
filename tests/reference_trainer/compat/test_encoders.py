"""The encoders against their formulas, corner by corner, and against SciPy; their gradients against differences."""

import itertools
import math

import pytest
import torch
from oracles import spherical_harmonics

from reference_trainer.compat.extensions import FreqEncoder, GridEncoder, SHEncoder


def _literal(encoder, position, kind, corners, smooth):
    """Mueller et al. 2022, section 3, for one position in [0, 1]^D, in Python's numbers."""
    found = []
    for level in range(encoder.num_levels):
        scale = encoder.base_resolution * encoder.per_level_scale**level - 1
        sides = math.ceil(scale) + 1 + (not corners)
        first, end = encoder.offsets[level].item(), encoder.offsets[level + 1].item()
        place = [x * scale + (0 if corners else 0.5) for x in position]
        cell = [math.floor(x) for x in place]
        part = [x - c for x, c in zip(place, cell, strict=True)]
        part = [t * t * (3 - 2 * t) for t in part] if smooth else part
        features = [0.0] * encoder.level_dim
        for step in itertools.product((0, 1), repeat=len(cell)):
            weight = math.prod(t if s else 1 - t for s, t in zip(step, part, strict=True))
            corner = [c + s for c, s in zip(cell, step, strict=True)]
            row = sum(c * sides**axis for axis, c in enumerate(corner))
            if kind == "hash" and sides ** len(cell) > end - first:
                row = 0
                for c, prime in zip(corner, (1, 2654435761, 805459861), strict=False):
                    row ^= c * prime % 2**32
            row = first + row % (end - first)
            for channel in range(encoder.level_dim):
                features[channel] += weight * encoder.embeddings[row, channel].item()
        found += features
    return found


@pytest.mark.parametrize(("kind", "corners", "smooth", "dim"), [
    ("hash", False, False, 3), ("hash", True, True, 3), ("hash", False, True, 2), ("tiled", False, False, 2),
])  # fmt: skip
def test_the_grid_is_interpolated_from_the_corners_of_every_level(kind, corners, smooth, dim):
    torch.manual_seed(0)
    encoder = GridEncoder(
        dim, num_levels=5, level_dim=2, base_resolution=4, log2_hashmap_size=8, desired_resolution=60, gridtype=kind,
        align_corners=corners, interpolation="smoothstep" if smooth else "linear",
    ).double()  # fmt: skip
    torch.nn.init.normal_(encoder.embeddings)
    rows = encoder.offsets.diff()
    assert rows[0] < rows[-1] == 256  # coarse levels have a row per corner, fine ones share them
    positions = torch.rand(20, dim).double()
    found = encoder(3 * (2 * positions - 1), bound=3)
    slow = positions.new_tensor([_literal(encoder, x, kind, corners, smooth) for x in positions.tolist()])
    torch.testing.assert_close(found, slow, rtol=1e-9, atol=1e-9)


def test_outside_of_the_grid_there_is_nothing():
    encoder = GridEncoder(num_levels=2, log2_hashmap_size=8)
    positions = torch.tensor([[0.2, 0.1, 1.01], [0.2, 0.1, 0.99], [-1.2, 0.0, 0.0]], requires_grad=True)
    features = encoder(positions)
    features.sum().backward()
    assert features.ne(0).any(1).tolist() == positions.grad.ne(0).any(1).tolist() == [False, True, False]
    assert encoder(positions.detach().view(3, 1, 3)).shape == (3, 1, 4)


def test_gradients_of_the_grid_are_those_of_differences():
    torch.manual_seed(1)
    encoder = GridEncoder(2, num_levels=3, base_resolution=3, log2_hashmap_size=5).double()
    torch.nn.init.normal_(encoder.embeddings)
    positions = torch.rand(6, 2).double().requires_grad_()  # none within a millionth of the border of a cell

    def encode(positions, embeddings):
        return torch.func.functional_call(encoder, {"embeddings": embeddings}, (positions,))

    assert torch.autograd.gradcheck(encode, (positions, encoder.embeddings))


def test_harmonics_are_scipys():
    directions = torch.nn.functional.normalize(torch.randn(30, 3, generator=torch.Generator().manual_seed(2)).double())
    for degree in (1, 4, 8):  # the encoder's degree 1 is the constant alone
        found = SHEncoder(degree=degree)(2 * directions, size=2)
        torch.testing.assert_close(found, spherical_harmonics(directions, degree - 1), rtol=1e-9, atol=1e-9)
    leaves = directions[:4].clone().requires_grad_()
    assert torch.autograd.gradcheck(SHEncoder(degree=5), (leaves,))


@pytest.mark.parametrize("arguments", [{"degree": 0}, {"degree": 9}, {"input_dim": 2}])
def test_other_harmonics_are_refused(arguments):
    with pytest.raises(ValueError, match="degree 1 to 8"):
        SHEncoder(**arguments)


def test_frequencies_follow_the_vector_itself():
    encoder = FreqEncoder(input_dim=2, degree=3)
    vectors = torch.randn(5, 4, 2, generator=torch.Generator().manual_seed(3)).double().requires_grad_()
    found = encoder(vectors)
    assert found.shape == (5, 4, encoder.output_dim) == (5, 4, 14)
    for a, b in [(0, 0), (4, 3)]:
        v = vectors[a, b].tolist()
        waves = [f(2**k * x) for k in range(3) for f in (math.sin, math.cos) for x in v]
        torch.testing.assert_close(found[a, b].tolist(), [*v, *waves], rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(encoder, (vectors,))
