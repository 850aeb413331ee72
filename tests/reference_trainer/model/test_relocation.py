"""What the MCMC strategy computes, against its formula and gsplat's own torch code."""

import math

import pytest
import torch

from reference_trainer.model.relocation import compute_relocation, quat_scale_to_covar_preci


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


@pytest.mark.parametrize("triu", [True, False])
def test_covariances_are_gsplats(triu):
    own = pytest.importorskip("gsplat.cuda._torch_impl")
    generator = torch.Generator().manual_seed(1)
    quats, scales = (
        torch.randn(7, 4, generator=generator).double(),
        torch.rand(7, 3, generator=generator).double() + 0.1,
    )
    for ours, theirs in zip(
        quat_scale_to_covar_preci(quats, scales, triu=triu),
        own._quat_scale_to_covar_preci(quats, scales, triu=triu),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    assert quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None
