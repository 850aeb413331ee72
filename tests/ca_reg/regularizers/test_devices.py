"""Every registered regularizer wherever the Gaussians are: the draw is the generator's, the result theirs."""

import pytest
import torch

from ca_reg import Params
from ca_reg.regularizers import REGULARIZERS, parse

ARGUMENTS = {"dropout": "(0.5)", "noise": "(0.5)", "clustered": "(0.3)", "position_noise": "(0.1)"}

N = 60


def params(chain, device) -> Params:
    g = torch.Generator().manual_seed(0)
    named = {"means": (3,), "scales": (3,), "quaternions": (4,), "sh": (9, 3)}
    tensors = {name: (0.1 + torch.rand(N, *shape, generator=g)).to(device) for name, shape in named.items()}
    learned = {name: torch.full((N,), of.start, device=device) for name, of in chain.learns.items()}
    opacities = torch.rand(N, generator=g).to(device)
    return Params(opacities, **tensors, view_matrix=torch.eye(4, device=device), learned=learned, step=3_000)


@pytest.mark.parametrize("name", list(REGULARIZERS))
def test_draw_and_test_time_value_are_those_of_the_cpu(name, device):
    chain = parse(name + ARGUMENTS.get(name, ""))
    for mode in (True, False):
        chain.train(mode)
        here, there = (
            chain(params(chain, where), generator=torch.Generator().manual_seed(1)) for where in ("cpu", device)
        )
        for field in ("opacities", "means", "scales", "quaternions", "sh"):
            x, y = getattr(here, field), getattr(there, field)
            assert y.device.type == device.type, field
            torch.testing.assert_close(y.cpu(), x)
