""""""

import math

import pytest
import torch

from reference_trainer.model.gaussians import SH_C0, Gaussians, compute_relocation


def some(n: int = 6, degree: int = 1) -> Gaussians:
    g = torch.Generator().manual_seed(1)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        log_scales=torch.randn(n, 3, generator=g),
        quaternions=torch.randn(n, 4, generator=g),
        opacity_logits=torch.randn(n, generator=g),
        sh_dc=torch.randn(n, 1, 3, generator=g),
        sh_rest=torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g),
    )


def test_points_become_round_gaussians_of_their_color():
    positions, colors, distances = torch.rand(5, 3), torch.rand(5, 3), torch.rand(5) + 0.1
    made = Gaussians.from_points(positions, colors, distances, sh_degree=2, opacity=0.3)
    assert torch.equal(made.means, positions)
    torch.testing.assert_close(made.scales, distances[:, None].expand(5, 3))
    torch.testing.assert_close(made.opacities, torch.full((5,), 0.3))
    torch.testing.assert_close(made.sh_dc[:, 0] * SH_C0 + 0.5, colors)
    assert torch.equal(made.sh_rest, torch.zeros(5, 8, 3))
    assert torch.equal(made.quaternions, torch.tensor([[1.0, 0, 0, 0]]).expand(5, 4))
    made.means.zero_()
    assert positions.abs().sum() > 0  # a copy, not a view


def test_the_constant_band_is_the_textbook_value():
    assert math.sqrt(1 / (4 * math.pi)) == SH_C0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_activations_and_views(degree):
    model = some(degree=degree)
    assert model.sh_degree == degree
    assert model.sh.shape == (6, (degree + 1) ** 2, 3)
    assert torch.equal(model.sh[:, 0], model.sh_dc[:, 0])
    torch.testing.assert_close(model.opacities, 1 / (1 + torch.exp(-model.opacity_logits)))
    torch.testing.assert_close(model.scales.log(), model.log_scales)
    torch.testing.assert_close(torch.logit(model.opacities), model.opacity_logits)


@pytest.mark.parametrize("index", [torch.tensor([4, 0, 4]), torch.tensor([True, False, True, True, False, False])])
def test_indexing_takes_the_same_rows_of_everything(index):
    model = some()
    part = model[index]
    assert [name for name, _ in part.named()] == [
        "means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest",
    ]  # fmt: skip
    for (_, new), (_, old) in zip(part.named(), model.named(), strict=True):
        assert torch.equal(new, old[index])
    assert len(part) == 3


@pytest.mark.parametrize(
    ("name", "shape"),
    [("log_scales", (6, 2)), ("quaternions", (5, 4)), ("opacity_logits", (6, 1)), ("sh_dc", (6, 3)),
     ("sh_rest", (6, 9)), ("sh_rest", (6, 4, 3)), ("means", (6, 4))],
)  # fmt: skip
def test_wrong_shapes_are_named(name, shape):
    with pytest.raises(ValueError, match=f"{name} must"):
        Gaussians(**dict(some().named()) | {name: torch.zeros(shape)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": torch.tensor([[0.0, float("nan"), 0.0]])}, "positions must be finite"),
        ({"colors": torch.tensor([[0.0, float("inf"), 0.0]])}, "colors must be finite"),
        ({"distances": torch.zeros(1)}, "distances must be positive"),
        ({"distances": torch.tensor([float("nan")])}, "distances must be positive"),
        ({"distances": torch.tensor([float("inf")])}, "distances must be positive"),
        ({"opacity": 1.0}, r"opacity .*\(0, 1\), got 1.0"),
        ({"opacity": float("nan")}, "opacity must be in"),
    ],
)
def test_points_without_finite_parameters_are_refused(change, message):
    good = {"positions": torch.zeros(1, 3), "colors": torch.zeros(1, 3), "distances": torch.ones(1), "sh_degree": 0}
    with pytest.raises(ValueError, match=message):
        Gaussians.from_points(**good | change)


@pytest.mark.parametrize("min_opacity", [0.0, 0.3])
def test_relocation_is_equation_9(min_opacity):
    table = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float64)
    opacities = torch.tensor([0.01, 0.3, 0.6, 0.99, 0.5, 0.9])
    scales = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)) + 0.1
    ratios = torch.tensor([1, 2, 5, 51, 400, 3])  # at most 51 are told apart
    found = compute_relocation(opacities, scales, ratios, table, *([min_opacity] if min_opacity else []))
    for i, (o, n) in enumerate(zip(opacities.tolist(), ratios.clamp(max=51).tolist(), strict=True)):
        new = max(1 - (1 - o) ** (1 / n), min_opacity)
        shrink = sum(
            math.comb(m - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for m in range(1, n + 1)
            for k in range(m)
        )
        assert found[0][i].item() == pytest.approx(new, rel=1e-6)
        torch.testing.assert_close(found[1][i], scales[i] * (o / shrink), rtol=1e-5, atol=0)
    column, same = compute_relocation(opacities[:, None], scales, ratios, table, min_opacity)  # splatfacto's
    assert torch.equal(column, found[0][:, None])
    assert torch.equal(same, found[1])
