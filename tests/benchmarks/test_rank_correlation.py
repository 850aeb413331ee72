import math

import numpy as np
import pytest

from benchmarks.rank_correlation import kendall, spearman


@pytest.mark.parametrize("levels", [2, 4, 1000])  # nearly everything tied, many ties, hardly any
@pytest.mark.parametrize("n", [2, 3, 7, 40])
def test_they_are_those_of_scipy(n, levels):
    from scipy.stats import kendalltau, spearmanr  # a second to import

    rng = np.random.default_rng(n * levels)
    compared = 0
    for _ in range(30):
        x, y = rng.integers(levels, size=(2, n)) / 7 - 1
        if len(set(x)) > 1 and len(set(y)) > 1:
            assert spearman(x, y) == pytest.approx(spearmanr(x, y).statistic, abs=1e-12)
            assert kendall(x, y) == pytest.approx(kendalltau(x, y).statistic, abs=1e-12)
            compared += 1
    assert compared >= 5


@pytest.mark.parametrize("correlation", [spearman, kendall])
def test_only_the_order_matters(correlation):
    x = [0.3, -1.0, 2.0, 0.31, 5.0]
    assert correlation(x, [math.exp(v) for v in x]) == pytest.approx(1)
    assert correlation(x, [-(v**3) for v in x]) == pytest.approx(-1)


@pytest.mark.parametrize("correlation", [spearman, kendall])
def test_without_an_order_there_is_no_correlation(correlation):
    assert correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is None
    assert correlation([1.0, 2.0], [0.1, 0.1]) is None
    assert correlation([1.0], [2.0]) is None


@pytest.mark.parametrize("correlation", [spearman, kendall])
def test_refusals(correlation):
    with pytest.raises(ValueError, match=r"of one length, at least 1, got shapes \(2,\) and \(3,\)"):
        correlation([1.0, 2.0], [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="at least 1"):
        correlation([], [])
    with pytest.raises(ValueError, match="leave out the pairs"):
        correlation([1.0, math.nan], [1.0, 2.0])
