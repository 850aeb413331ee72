"""The mean over the views of two processes."""

import math

import pytest
import torch
from ranks import on_ranks

from ca_reg import CAScore

VIEWS = 5
OPACITY = torch.full((30,), 0.5)
SPLITS = {  # which views the ranks measure
    "in turn": ([0, 2, 4], [1, 3]),
    "unevenly": ([0, 1, 3, 4], [2]),
    "all on one": ([], [0, 1, 2, 3, 4]),
    "empty on one": ([0, 2, 3, 4], [1]),
    "no view anywhere": ([], []),
}


def make_scores(not_finite_view=None):
    """One score of every method."""
    colors = torch.rand(3, 30, generator=torch.Generator().manual_seed(0))

    def render_fn(opacity, view):
        # View 1 shows nothing, so that one rank has an empty view.
        alpha = torch.full((4, 4), 0.0 if view == 1 else 1.0)
        brightness = math.nan if view == not_finite_view else (view + 1) / 100  # colors stay within [0, 1]
        return (colors @ opacity)[:, None, None].expand(3, 4, 4) * brightness, alpha

    def moments_fn(opacity, view, multiplier, background):
        image, alpha = render_fn(multiplier.mean * opacity, view)
        return {"mean": image, "variance": multiplier.variance * image, "alpha_mean": alpha}

    return [
        CAScore(render_fn),
        CAScore.adaptive(render_fn, relative_error=0.3),
        CAScore.exact(moments_fn),
        CAScore.exact(moments_fn, neutral=True),
    ]


def measure(rank):
    """The summaries of every split, and of views without an index; runs in a process of its own."""
    answer = {}
    for name, split in SPLITS.items():
        scores = make_scores()
        for score in scores:
            for view in split[rank]:
                score.update(OPACITY, view, index=view)
        answer[name] = [score.compute().as_dict() for score in scores]
    by_default, diverged = make_scores()[0], make_scores(not_finite_view=3)[0]
    for view in SPLITS["in turn"][rank]:
        by_default.update(OPACITY, view)
        diverged.update(OPACITY, view)
    answer["by default"] = [by_default.compute().as_dict()]
    answer["not finite"] = [diverged.compute().as_dict()]
    return answer


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    """What each of the two processes found."""
    return on_ranks(__file__, "measure", tmp_path_factory.mktemp("rendezvous"))


def assert_is_the_mean(found, score, views):
    """Compare with the mean of single views, taken without a tally."""
    results = [score(OPACITY, view, index=view) for view in views]
    counted = [result for result in results if result.reason.name == "OK"]
    assert found["method"] == score.settings.method
    assert (found["views"], found["empty_views"]) == (len(results), len(results) - len(counted))
    if not counted:
        assert (found["value"], found["std_error"], found["reason"]) == (None, None, "NO_VIEWS")
        return
    value = math.fsum(result.value for result in counted) / len(counted)
    std_error = math.sqrt(math.fsum(result.std_error**2 for result in counted)) / len(counted)
    assert found["reason"] == "OK"
    assert found["value"] == pytest.approx(value, rel=1e-14)
    assert found["std_error"] == pytest.approx(std_error, rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", SPLITS)
def test_every_split_gives_every_rank_the_mean_over_all_views(ranks, name):
    assert ranks[0][name] == ranks[1][name]
    for found, score in zip(ranks[0][name], make_scores(), strict=True):
        assert_is_the_mean(found, score, sorted([*SPLITS[name][0], *SPLITS[name][1]]))


@pytest.mark.slow
def test_views_that_are_dealt_out_in_turn_need_no_index(ranks):
    assert ranks[0]["by default"] == ranks[1]["by default"]
    assert_is_the_mean(ranks[0]["by default"][0], make_scores()[0], range(VIEWS))


@pytest.mark.slow
def test_a_view_that_is_not_finite_is_known_to_all_ranks(ranks):
    for found in ranks:
        assert (found["not finite"][0]["reason"], found["not finite"][0]["value"]) == ("NOT_FINITE", None)
