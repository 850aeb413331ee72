"""When rules look at neighbors, what their state is, and what all of them have in common."""

import copy
import pickle
from pathlib import Path

import pytest
import torch
from clouds import KINDS, cloud, params, rank

from ca_reg import Chain
from ca_reg.regularizers import REGULARIZERS, parse, surroundings
from ca_reg.regularizers.surroundings import Refreshed, relative_ranks, surface_variation

LOOKING = ("clustered(0.3)", "d2gs", "density", "drop_anchors", "geometry", "position_noise(0.3)")
ALL = (*LOOKING, "d2gs(literal=True)", "depth", "drop_sh(until=[9_000])")


def _rule(text):
    (rule,) = parse(text)
    return rule


@pytest.fixture
def looks(monkeypatch):
    """The numbers of points of all searches for neighbors."""
    found, search = [], surroundings.nearest_neighbors
    monkeypatch.setattr(
        surroundings, "nearest_neighbors", lambda means, count: (found.append(len(means)), search(means, count))[1]
    )
    return found


@pytest.mark.parametrize("text", LOOKING)
def test_neighbors_are_sought_every_so_many_steps_and_when_the_number_changes(text, looks):
    rule = _rule(text)
    every = 500 if text == "d2gs" else 100
    points = cloud("spread")
    for step in range(1, 2 * every + 2, 10):
        rule.regularize(params(points + 1e-3 * step, step))
    assert looks == [40, 40, 40]
    rule.regularize(params(points[:30], 2 * every + 5))
    rule.regularize(params(points[:30], 2 * every + 6))
    assert looks == [40, 40, 40, 30]
    rule.regularize(params(points[:30], 7))
    assert looks == [40, 40, 40, 30, 30], "an earlier step is that of another training"


def test_centers_that_an_optimizer_moves_behind_torchs_back_are_sought_again(looks):
    """As kernels do, that write to the memory of a parameter."""
    rule, means = _rule("density"), torch.nn.Parameter(cloud("spread"))
    for step in range(1, 202, 10):
        rule.regularize(params(means, step)._replace(means=means))
        means.detach().numpy()[:] += 1e-3
    assert looks == [40, 40, 40]


@pytest.mark.parametrize("text", LOOKING)
def test_another_model_of_as_many_gaussians_is_not_taken_for_the_last(text, looks):
    rule, first, second = _rule(text), params(cloud("spread")), params(cloud("duplicates"))
    for x in (first, first, second, second):
        rule.regularize(x)
    assert looks == [40, 40]
    second.means.add_(torch.rand_like(second.means))
    rule.regularize(second)
    assert looks == [40, 40, 40]


@pytest.mark.parametrize("text", LOOKING)
def test_nothing_is_sought_while_the_rate_is_0(text, looks):
    off = {
        "clustered(0.3)": "clustered(between(0.3, 9_000))",
        "d2gs": "d2gs(between(0.3, 9_000))",
        "density": "density(0, 0)",
        "drop_anchors": "drop_anchors(between(0.02, 9_000))",
        "geometry": "geometry(0, 0)",
        "position_noise(0.3)": "position_noise(between(0.3, 9_000))",
    }[text]
    rule, x = _rule(off), params(cloud("spread"))
    assert rule.regularize(x) is x
    assert rule.eval()(x) is x
    assert rule.last is None
    assert not looks


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda rule: pickle.loads(pickle.dumps(rule)), "state_dict"])
@pytest.mark.parametrize("text", LOOKING)
def test_a_copy_goes_on_as_the_original_would(text, copied, looks):
    rule = Chain(_rule(text))
    rule.regularize(params(cloud("spread"), step=1_000))
    later = params(cloud("spread").flip(0), step=1_020)  # others are neighbors by now, which is not yet looked at
    if copied == "state_dict":
        twin = Chain(_rule(text))
        twin.load_state_dict(rule.state_dict())
    else:
        twin = copied(rule)
    drawn = [one.regularize(later, torch.Generator().manual_seed(4)) for one in (rule, twin)]
    assert torch.equal(drawn[0].opacities, drawn[1].opacities)
    assert torch.equal(drawn[0].means, drawn[1].means)
    assert looks == [40]


def test_a_state_without_neighbors_starts_afresh(looks):
    rule = _rule("density")
    assert not rule.state_dict()
    x = params(cloud("spread"))
    rule.regularize(x)
    assert set(rule.state_dict()) == {"trained.value", "trained.since"}
    rule.load_state_dict({})
    rule.regularize(x)
    assert looks == [40, 40]


@pytest.mark.parametrize("text", ALL)
def test_what_inference_mode_found_serves_in_training(text):
    rule = _rule(text.replace("density", "density(compensate=True)"))
    with torch.inference_mode():
        rule.regularize(params(cloud("spread"), step=1_001))
        rule.expected(params(cloud("spread")))
    x = params(cloud("spread"), step=1_002)
    opacities = x.opacities.requires_grad_()
    rule.regularize(x).opacities.sum().backward()
    assert bool(opacities.grad.isfinite().all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("text", ALL)
def test_draws_repeat_with_the_generator_and_replay(text, kind):
    x = params(cloud(kind))
    rule = _rule(text)
    first = rule(x, generator=torch.Generator().manual_seed(9))
    again = _rule(text)(x, generator=torch.Generator().manual_seed(9))
    replayed = rule(x, drawn=rule.last)
    for other in (again, replayed):
        assert all(torch.equal(a, b) for a, b in zip(first[:2], other[:2], strict=True))
        assert torch.equal(first.sh, other.sh)
    assert bool(first.means.isfinite().all())
    assert rule.eval()(x).opacities.shape == x.opacities.shape


@pytest.mark.parametrize("text", ALL)
def test_without_gaussians_there_is_nothing_to_do(text):
    x = params(torch.zeros(0, 3))
    assert len(_rule(text)(x).opacities) == 0


@pytest.mark.parametrize("text", ALL)
def test_they_work_on_any_device(text, device):
    x = params(cloud("spread").float())
    expected = _rule(text)(x, generator=torch.Generator().manual_seed(9))
    there = x._replace(**{name: getattr(x, name).to(device) for name in ("opacities", "means", "sh", "view_matrix")})
    out = _rule(text)(there, generator=torch.Generator().manual_seed(9))
    for name in ("opacities", "means", "sh"):
        assert getattr(out, name).device.type == device.type
        torch.testing.assert_close(getattr(out, name).cpu(), getattr(expected, name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("text", [*LOOKING, "depth", "drop_sh"])
def test_they_say_what_they_need(text):
    rule = _rule(text)
    with pytest.raises(ValueError, match=f"{type(rule).__name__} needs {', '.join(rule.needs)} of the Gaussians"):
        rule(torch.ones(3))


def test_ranks_share_ties():
    values = torch.randint(0, 9, (50,), generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(relative_ranks(values), torch.from_numpy(rank(values.numpy())))
    assert relative_ranks(torch.full((4,), 3.0)).tolist() == [0.5] * 4


def test_every_must_be_a_number_of_steps():
    with pytest.raises(ValueError, match=r"every .*at least 1"):
        Refreshed(0)


def test_every_regularizer_has_a_row_in_the_docs():
    page = (Path(__file__).parents[3] / "docs" / "regularizers.md").read_text("utf-8")
    assert not [name for name in REGULARIZERS if f"\n| `{name}`" not in page]


@pytest.mark.parametrize("text", ["geometry", "depth", "d2gs", "density", "drop_anchors(0.1)", "position_noise(0.1)"])
def test_autocast_costs_no_precision(text):
    """Centers around a place far from the origin, so that 16 bits could not tell their depths apart."""
    x = params(cloud("spread", 300).float() + 100, step=10_000)
    plain, cast = parse(text), parse(text)
    expected = plain(x, generator=torch.Generator().manual_seed(0))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = cast(x, generator=torch.Generator().manual_seed(0))
    assert torch.equal(found.opacities, expected.opacities)
    assert torch.equal(found.means, expected.means)


def test_the_surroundings_are_measured_in_full_precision():
    points = cloud("spread", 300).float()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = surface_variation(points, 10)
    assert torch.equal(found, surface_variation(points, 10))


def test_planes_are_told_from_volumes_in_chunks(monkeypatch):
    points = cloud("spread", 300)
    whole = surface_variation(points, 10)
    monkeypatch.setattr("ca_reg.regularizers.surroundings.EIGEN_CHUNK", 7)
    assert torch.equal(surface_variation(points, 10), whole)
