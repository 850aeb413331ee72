"""The score as a torchmetrics metric: what users of image metrics expect, and the sum over ranks."""

import difflib
import doctest
import importlib.util
import math
import pickle

import pytest
import torch
from ranks import on_ranks

from ca_reg import CAScore

# Torchmetrics takes two seconds to import, so the tests do it, and not the collection of all tests.
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("torchmetrics") is None, reason="needs torchmetrics (the extra torchmetrics)"
)

OPACITY = torch.linspace(0.1, 0.9, 30)
COLORS = torch.rand(3, 30, generator=torch.Generator().manual_seed(0)) / 200  # in [0, 1] in all views
SPLITS = {"in turn": ([0, 2, 4], [1, 3]), "all on one": ([], [0, 1, 2, 3, 4])}  # view 1 is empty

USERS_FILE = """
from torchmetrics import MetricCollection
from torchmetrics.image import PeakSignalNoiseRatio

def evaluate(render_fn, opacities, views):
    metrics = MetricCollection({
        "psnr": PeakSignalNoiseRatio(1.0),
    })
    for camera, photograph in views:
        image, alpha = render_fn(opacities, camera)
        metrics.update(
            preds=image, target=photograph,
        )
    return metrics.compute()
"""
ADDED = {
    "import PeakSignalNoiseRatio\n": "from ca_reg.integrations.torchmetrics import CAScoreMetric\n",
    "PeakSignalNoiseRatio(1.0),\n": '        "ca": CAScoreMetric(render_fn),\n',
    "target=photograph,\n": "            opacity=opacities, view=camera,\n",
}


def CAScoreMetric(score):
    from ca_reg.integrations.torchmetrics import CAScoreMetric

    return CAScoreMetric(score)


def render_fn(opacity, view):
    """A flat picture whose brightness is the view; view 1 shows nothing."""
    return (COLORS @ opacity)[:, None, None].expand(3, 4, 4) * (view + 1), torch.full((4, 4), float(view != 1))


def mean_over(views, score=None):
    """Value and standard error of the mean, from single views."""
    score = score or CAScore(render_fn)
    results = [score(OPACITY, view, index=view) for view in views]
    counted = [result for result in results if result.reason.name == "OK"]
    error = math.sqrt(math.fsum(result.std_error**2 for result in counted))
    return math.fsum(result.value for result in counted) / len(counted), error / len(counted)


def measure(rank):
    """What the metric says for every split of the views; runs in a process of its own."""
    answer = {}
    for name, split in SPLITS.items():
        metric = CAScoreMetric(render_fn)
        for view in split[rank]:
            metric.update(OPACITY, view, index=view)
        summary = metric.summary().as_dict()
        answer[name] = {"value": metric.compute().item(), "summary": summary, "local": metric.sums[2].item()}
    metric = CAScoreMetric(render_fn)
    forward = [metric(OPACITY, view).item() for view in SPLITS["in turn"][rank]]
    answer["forward"] = {"own": forward, "value": metric.compute().item()}
    return answer


@pytest.mark.slow
def test_two_ranks_sum_their_states(tmp_path):
    ranks = on_ranks(__file__, "measure", tmp_path)
    value, std_error = mean_over(range(5))
    for name, split in SPLITS.items():
        for rank, found in enumerate(ranks):
            assert found[name]["value"] == pytest.approx(value, rel=1e-14)
            assert found[name]["summary"]["std_error"] == pytest.approx(std_error, rel=1e-14)
            assert (found[name]["summary"]["views"], found[name]["summary"]["empty_views"]) == (5, 1)
            assert found[name]["local"] == len(split[rank])  # the sync is undone: the rank can go on counting
    for rank, found in enumerate(ranks):  # no index was given: the views were dealt out in turn
        assert found["forward"]["value"] == pytest.approx(value, rel=1e-14)
        expected = [CAScore(render_fn)(OPACITY, view, index=view).value for view in SPLITS["in turn"][rank]]
        assert found["forward"]["own"] == pytest.approx(expected, rel=1e-15, nan_ok=True)


def test_update_and_forward_count_alike_and_forward_returns_the_view():
    updated, called = CAScoreMetric(render_fn), CAScoreMetric(render_fn)
    for view in range(5):
        updated.update(OPACITY, view)
        value = called(OPACITY, view)
        assert value.shape == ()
        assert value.item() == pytest.approx(CAScore(render_fn)(OPACITY, view, index=view).value, nan_ok=True)
    assert updated.compute() == called.compute() == pytest.approx(mean_over(range(5))[0], rel=1e-14)


def test_the_summary_is_that_of_the_score():
    metric, score = CAScoreMetric(render_fn), CAScore(render_fn)
    for view in range(3):
        metric.update(OPACITY, view)
        score.update(OPACITY, view)
    assert metric.summary() == score.compute()


def test_takes_a_score_of_any_settings_and_leaves_its_count_alone():
    score = CAScore(render_fn, samples=9, ddof=1, drop_rate=0.3)
    metric = CAScoreMetric(score)
    metric.update(OPACITY, 2, index=7)
    assert metric.compute().item() == score(OPACITY, 2, index=7).value
    assert metric.summary().samples == 9
    assert score.compute().views == 0


def test_reset_forgets_all_and_starts_the_masks_again():
    metric = CAScoreMetric(render_fn)
    first = metric(OPACITY, 2)
    metric(OPACITY, 3)
    metric.reset()
    assert not metric.sums.any()
    assert metric(OPACITY, 2) == first


def test_without_views_it_says_so():
    metric = CAScoreMetric(render_fn)
    with pytest.warns(UserWarning, match="before .*``update``"):
        assert math.isnan(metric.compute())
    assert metric.summary().reason.name == "NO_VIEWS"


def test_one_metric_of_a_collection_never_takes_the_state_of_another():
    # A collection merges metrics whose states agree after the first update, here to 1e-8: both scores are 1e-10.
    def faint(opacity, view):
        return render_fn(opacity * 1e-5 * view, 0)

    from torchmetrics import MetricCollection

    for first_view in (1.0, 0.0):
        metrics = MetricCollection(
            {"five": CAScoreMetric(faint), "fewer": CAScoreMetric(CAScore(faint, drop_rate=0.2))}
        )
        metrics.update(OPACITY, first_view)
        metrics.update(OPACITY, 1e5)
        found = metrics.compute()
        for name, score in {"five": CAScore(faint), "fewer": CAScore(faint, drop_rate=0.2)}.items():
            expected = (score(OPACITY, first_view).value + score(OPACITY, 1e5, index=1).value) / 2
            assert found[name].item() == pytest.approx(expected, rel=1e-12)


def test_a_users_evaluation_takes_three_more_lines():
    with_score = USERS_FILE
    for place, line in ADDED.items():
        with_score = with_score.replace(place, place + line)
    changes = [x for x in difflib.ndiff(USERS_FILE.splitlines(), with_score.splitlines()) if x[0] in "+-"]
    assert len(changes) <= 3
    assert all(change.startswith("+") for change in changes)
    photographs = [(view, torch.full((3, 4, 4), 0.5)) for view in (0, 2)]
    scope = {}
    exec(USERS_FILE, scope)
    before = scope["evaluate"](render_fn, OPACITY, photographs)
    exec(with_score, scope)
    after = scope["evaluate"](render_fn, OPACITY, photographs)
    assert after["psnr"] == before["psnr"]
    score = CAScore(render_fn)
    expected = (score(OPACITY, 0, index=0).value + score(OPACITY, 2, index=1).value) / 2
    assert after["ca"].item() == pytest.approx(expected, rel=1e-14)


def test_collections_copy_and_prefix_it():
    from torchmetrics import MetricCollection
    from torchmetrics.image import PeakSignalNoiseRatio

    metrics = MetricCollection({"ca": CAScoreMetric(render_fn), "psnr": PeakSignalNoiseRatio(1.0)})
    test = metrics.clone(prefix="test/")
    test.update(opacity=OPACITY, view=0, preds=torch.zeros(3, 4, 4), target=torch.ones(3, 4, 4))
    assert test.compute()["test/ca"].item() == CAScore(render_fn)(OPACITY, 0).value
    assert not metrics["ca"].update_called


def test_a_clone_counts_for_itself_and_does_not_copy_the_model():
    class Model:
        def render(self, opacity, view):
            return render_fn(opacity, view)

        def __deepcopy__(self, memo):
            raise AssertionError("the model was copied")

    metric = CAScoreMetric(Model().render)
    metric.update(OPACITY, 0)
    twin = metric.clone()
    twin.update(OPACITY, 2)
    assert (metric.update_count, twin.update_count) == (1, 2)
    assert metric.sums[2] == 1
    assert twin.compute().item() == pytest.approx(
        (CAScore(render_fn)(OPACITY, 0).value + CAScore(render_fn)(OPACITY, 2, index=1).value) / 2
    )


def test_pickles_with_its_state():
    metric = CAScoreMetric(render_fn)
    metric.update(OPACITY, 0)
    copy = pickle.loads(pickle.dumps(metric))
    copy.update(OPACITY, 2)
    metric.update(OPACITY, 2)
    assert copy.compute() == metric.compute()


def test_the_state_is_saved_only_on_request():
    metric = CAScoreMetric(render_fn)
    metric.update(OPACITY, 0)
    assert metric.state_dict() == {}
    metric.persistent(True)
    other = CAScoreMetric(render_fn)
    other.persistent(True)
    other.load_state_dict(metric.state_dict())
    assert torch.equal(other.sums, metric.sums)


def test_states_of_parts_merge():
    parts = [CAScoreMetric(render_fn) for _ in range(2)]
    for view in range(5):
        parts[view % 2].update(OPACITY, view, index=view)
    parts[0].merge_state(parts[1])
    assert parts[0].summary().value == pytest.approx(mean_over(range(5))[0], rel=1e-14)


def test_moves_to_a_device_and_keeps_its_precision():
    metric = CAScoreMetric(render_fn).to("meta")
    assert metric.sums.device.type == "meta"
    half = CAScoreMetric(render_fn).half()
    half.update(OPACITY, 0)
    assert half.compute().dtype == torch.float64


def test_counts_on_the_device_what_was_rendered_there(device):
    metric = CAScoreMetric(lambda opacity, view: render_fn(opacity.cpu(), view)).to(device)
    metric.update(OPACITY.to(device), 0)
    assert metric.compute().device.type == device.type
    assert metric.compute().item() == CAScore(render_fn)(OPACITY, 0).value


def test_says_what_it_is():
    from torchmetrics.aggregation import SumMetric

    metric = CAScoreMetric(render_fn)
    assert (metric.higher_is_better, metric.is_differentiable, metric.full_state_update) == (False, False, False)
    composed = 2 * metric + SumMetric()
    composed.update(opacity=OPACITY, view=0, value=1.0)
    assert composed.compute().item() == pytest.approx(2 * CAScore(render_fn)(OPACITY, 0).value + 1)


def test_plots_one_value_or_many():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    metric = CAScoreMetric(render_fn)
    values = [metric(OPACITY, view) for view in (0, 2, 3)]
    _, ax = metric.plot()
    assert ax.lines[0].get_ydata() == pytest.approx(metric.compute().item())
    _, ax = metric.plot(values)
    assert list(ax.lines[0].get_ydata()) == pytest.approx([value.item() for value in values])
    matplotlib.pyplot.close("all")


def test_the_example_runs():
    from ca_reg.integrations import torchmetrics as adapter

    assert doctest.testmod(adapter) == (0, 7)
