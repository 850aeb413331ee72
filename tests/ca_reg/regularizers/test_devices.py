"""Every registered regularizer on the device and in the precision of the Gaussians, whatever the draw's."""

import itertools

import pytest
import torch
from stand_ins.card import counted_synchronizations

from ca_reg import Params
from ca_reg.neighbors import TREE_FROM
from ca_reg.regularizers import REGULARIZERS, parse

ARGUMENTS = {"dropout": "(0.5)", "noise": "(0.5)", "clustered": "(0.3)", "position_noise": "(0.1)"}

N = 60


def params(chain, device, n=N) -> Params:
    g = torch.Generator().manual_seed(0)
    named = {"means": (3,), "scales": (3,), "quaternions": (4,), "sh": (9, 3)}
    tensors = {name: (0.1 + torch.rand(n, *shape, generator=g)).to(device) for name, shape in named.items()}
    learned = {name: torch.full((n,), of.start, device=device) for name, of in chain.learns.items()}
    opacities = torch.rand(n, generator=g).to(device)
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


@pytest.mark.parametrize(
    "text", [*REGULARIZERS, "density(compensate=True)", "d2gs(literal=True)", "soft(by_size=True)"]
)
def test_a_warm_step_does_not_wait_for_the_card(text, card):
    chain = parse(text + ARGUMENTS.get(text, ""))
    x, radii = params(chain, card), torch.ones(N, device=card)
    for step in range(3_001, 3_005):  # neighbors are sought in the first
        opacities = x.opacities.clone().requires_grad_()
        chain.set_step(step)
        with counted_synchronizations() as found:
            out = chain(x._replace(opacities=opacities, step=step))
            if out.opacities.requires_grad:
                out.opacities.sum().backward()
            chain.mask_radii(radii)
    assert not found, found


@pytest.mark.parametrize("name", list(REGULARIZERS))
def test_the_test_time_value_copies_nothing_to_the_card(name, card):
    chain = parse(name + ARGUMENTS.get(name, "")).eval()
    x = params(chain, card)
    with counted_synchronizations() as found:
        chain(x)
    assert not {"aten::copy_", "aten::_to_copy"} & set(found), found


@pytest.mark.parametrize("name", list(REGULARIZERS))
@pytest.mark.parametrize("n", [N, TREE_FROM])
def test_another_default_device_changes_nothing(name, n, card):
    """As after ``torch.set_default_device("cuda")``, wherever the Gaussians are."""
    for where, training in itertools.product(("cpu", card), (True, False)):
        found = []
        for default in (torch.device("cpu"), card):
            chain = parse(name + ARGUMENTS.get(name, "")).train(training)
            x = params(chain, where, n)
            with default:
                found.append(chain(x, generator=torch.Generator("cpu").manual_seed(1)).opacities)
            assert found[-1].device == x.opacities.device
        assert torch.equal(*found)


TYPES = [(torch.float16, torch.float32), (torch.float32, torch.float16), (torch.bfloat16, torch.bfloat16)]


@pytest.mark.parametrize(("of_opacities", "of_others"), TYPES, ids=str)
@pytest.mark.parametrize(
    "name", [*REGULARIZERS, "density(compensate=True)", "concrete + density + noise(0.5, scale=True)"]
)
def test_precisions_are_kept_and_nothing_is_measured_in_half(name, of_opacities, of_others):
    """As in float32 with the same, rounded values; the centers are so far apart that squares would overflow in half."""
    chain = parse(name + ARGUMENTS.get(name, ""))
    x = params(chain, "cpu")
    x = x._replace(means=(x.means - 0.5) * 3_000, opacities=x.opacities.to(of_opacities))
    fields = ("means", "scales", "quaternions", "sh", "view_matrix")
    rough = x._replace(
        **{field: getattr(x, field).to(of_others) for field in fields},
        learned={key: value.to(of_others) for key, value in x.learned.items()},
    )
    wide = x._replace(
        **{field: getattr(rough, field).float() for field in ("opacities", *fields)},
        learned={key: value.float() for key, value in rough.learned.items()},
    )
    for training in (True, False):
        chain.train(training)
        found, expected = (chain(x, generator=torch.Generator().manual_seed(1)) for x in (rough, wide))
        for field in ("opacities", *fields):
            got = getattr(found, field)
            assert got.dtype == getattr(rough, field).dtype, field
            rounding = 8 * max(torch.finfo(dtype).eps for dtype in (of_opacities, of_others))
            scale = float(getattr(expected, field).abs().max())
            torch.testing.assert_close(got.float(), getattr(expected, field), rtol=0, atol=rounding * scale)
        if (multiplied := chain.alpha_factor(rough)) is not None:
            assert multiplied[0].opacities.dtype == of_opacities
