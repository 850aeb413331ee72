"""What the MCMC strategy computes, against its formula."""

import math

import pytest
import torch

from reference_trainer.model.relocation import compute_relocation


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
