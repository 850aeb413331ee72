"""The monitor's files, read back by other means; resuming; the figure."""

import json
import logging
import math
import subprocess
import sys
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from ca_reg import CAMonitor, CAScore
from ca_reg.monitor import plot_dynamics, read_dynamics
from ca_reg.sinks import Sink

OPACITY = torch.linspace(0.1, 0.9, 30)
COLORS = torch.rand(3, 30, generator=torch.Generator().manual_seed(0)) / 50  # in [0, 1] in all views
VIEWS = {"train": [1.0, 2.0], "test": [3.0]}


def render_fn(opacity, view):
    visible = torch.full((4, 4), float(view > 0))
    return (view * COLORS @ opacity)[:, None, None].expand(3, 4, 4), visible


def make(folder, **arguments):
    return CAMonitor(CAScore(render_fn, p=0.2), folder, **({"views": VIEWS, "every": 10} | arguments))


def run(monitor, start, stop):
    with monitor:
        return [record for step in range(start, stop) if (record := monitor(step, OPACITY)) is not None]


def lines(folder):
    return [json.loads(line) for line in (folder / "ca.jsonl").read_text().splitlines()]


def test_measures_on_its_turn_and_logs_what_it_returns(tmp_path):
    records = run(make(tmp_path), 1, 31)
    assert [record["step"] for record in records] == [10, 20, 30]
    assert lines(tmp_path) == records


def test_the_last_step_is_measured_whatever_it_is(tmp_path):
    assert [record["step"] for record in run(make(tmp_path, last_step=25), 1, 26)] == [10, 20, 25]


def test_a_second_monitor_of_the_same_folder_is_refused_until_the_first_is_closed(tmp_path):
    with make(tmp_path) as first:
        first(10, OPACITY)
        with pytest.raises(BlockingIOError, match="another CAMonitor"):
            make(tmp_path, resume_step=10)
        first(20, OPACITY)
    run(make(tmp_path, resume_step=20), 21, 31)
    assert [record["step"] for record in lines(tmp_path)] == [10, 20, 30]


@pytest.mark.slow
def test_another_process_is_refused_as_well(tmp_path):
    code = """
import sys, torch
from ca_reg import CAMonitor, CAScore
score = CAScore(lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)))
try:
    CAMonitor(score, sys.argv[1], views={"test": [None]})
except BlockingIOError:
    print("refused", flush=True)
sys.stdin.read()  # until the other monitor is closed
CAMonitor(score, sys.argv[1], views={"test": [None]})
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        with make(tmp_path):
            assert process.stdout.readline() == "refused\n"
        process.stdin.close()
        assert process.wait() == 0


def test_the_values_are_those_of_the_score(tmp_path):
    (record,) = run(make(tmp_path), 10, 11)
    score = CAScore(render_fn, p=0.2)
    for view in VIEWS["train"]:
        score.update(OPACITY, view)
    assert record["ca/train"] == score.compute().value
    assert record["ca_std_error/train"] == score.compute().std_error
    assert record["ca/test"] == score(OPACITY, 3.0, index=2).value
    assert record["gaussians"] == 30
    assert record["drop_rate"] == pytest.approx(0.6)
    assert (record["samples"], record["threshold"], record["ddof"], record["seed"]) == (5, 0.8, 0, 0)
    assert "psnr/train" not in record


def test_psnr_gets_the_opacities_of_the_test_and_is_averaged_over_views(tmp_path):
    def psnr(opacity, view):
        assert not torch.is_grad_enabled()
        torch.testing.assert_close(opacity, OPACITY * 0.8)
        return 10 * view

    (record,) = run(make(tmp_path, psnr=psnr), 10, 11)
    assert record["psnr/train"] == 15.0
    assert record["psnr/test"] == 30.0


def test_views_may_come_from_any_iterable(tmp_path):
    (expected,) = run(make(tmp_path / "lists"), 10, 11)
    views = {name: (view for view in group) for name, group in VIEWS.items()}
    assert run(make(tmp_path / "iterators", views=views), 10, 21)[0] == expected
    with pytest.raises(ValueError, match=r"\{'test': 0\}; leave out"):
        make(tmp_path, views={"test": iter(())})


@pytest.mark.parametrize("step", [10.0, -10, True])
def test_a_step_that_is_none_is_refused_before_it_is_logged(tmp_path, step):
    with make(tmp_path) as monitor:
        with pytest.raises((TypeError, ValueError), match="step must be"):
            monitor(step, OPACITY)
        assert monitor(np.int64(10), OPACITY)["step"] == 10
    assert [line["step"] for line in lines(tmp_path)] == [10]


def test_a_line_is_on_disk_when_the_call_returns(tmp_path):
    with make(tmp_path) as monitor:
        monitor(10, OPACITY)
        assert len(lines(tmp_path)) == 1


def test_groups_without_a_value_are_null_with_a_reason(tmp_path):
    (record,) = run(make(tmp_path, views={"test": [0.0]}, psnr=lambda o, v: math.inf), 10, 11)
    assert record["ca/test"] is None
    assert record["ca_reason/test"] == "EMPTY"
    assert record["ca_empty_views/test"] == 1
    assert record["psnr/test"] is None
    monitor = make(tmp_path / "masked", views={"test": [0.0, 1, 2]}, psnr=lambda o, v: 20 + v if v else math.nan)
    assert run(monitor, 10, 11)[0]["psnr/test"] == 21.5  # of a black mask there is none
    assert np.isnan(read_dynamics(tmp_path)["ca/test"]).all()


def test_a_resumed_run_continues_the_log_of_the_uninterrupted_one(tmp_path):
    whole = run(make(tmp_path / "whole"), 1, 61)
    run(make(tmp_path / "parts"), 1, 46)  # killed at 45 with half a line, the checkpoint was made at 30
    with (tmp_path / "parts" / "ca.jsonl").open("a") as file:
        file.write('{"step": 50, "ga')
    resumed = run(make(tmp_path / "parts", resume_step=30), 30, 61)
    assert [record["step"] for record in resumed] == [40, 50, 60]
    assert lines(tmp_path / "parts") == whole


def test_a_new_run_replaces_the_log(tmp_path):
    run(make(tmp_path), 1, 31)
    run(make(tmp_path), 1, 11)
    assert [line["step"] for line in lines(tmp_path)] == [10]


def test_tensorboard_gets_the_same_scalars(tmp_path, caplog):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with caplog.at_level(logging.INFO, logger="ca_reg.monitor"):
        monitor = make(tmp_path, psnr=lambda o, v: 20 + v)
    assert monitor.backends == ("jsonl", "tensorboard")
    assert "jsonl, tensorboard" in caplog.text
    records = run(monitor, 1, 31)
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    tags = {"ca/train", "ca/test", "psnr/train", "psnr/test", "gaussians"}
    assert set(events.Tags()["scalars"]) == tags
    for tag in tags:
        assert [event.step for event in events.Scalars(tag)] == [10, 20, 30]
        np.testing.assert_allclose([e.value for e in events.Scalars(tag)], [r[tag] for r in records], rtol=1e-6)


def test_tensorboard_shows_the_details_of_the_first_view_of_each_group(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    image = torch.arange(60).reshape(3, 4, 5) / 255

    def details(opacity, view):
        assert not torch.is_grad_enabled()
        opacity.mul_(view)
        return {"picture": image * view, "shares": opacity, "none": opacity[:0]}

    records = run(make(tmp_path, details=details), 1, 31)
    assert records == run(make(tmp_path / "without"), 1, 31)
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    for group, view in (("train", 1.0), ("test", 3.0)):
        shown = events.Images(f"picture/{group}")
        assert [event.step for event in shown] == [10, 20, 30]
        with Image.open(BytesIO(shown[-1].encoded_image_string)) as file:
            pixels = np.asarray(file)
        np.testing.assert_array_equal(pixels, (image * view * 255).round().permute(1, 2, 0))
        shares = events.Histograms(f"shares/{group}")[-1].histogram_value
        assert (shares.num, shares.min, shares.max) == pytest.approx((30, 0.1 * view, 0.9 * view))
    assert len(events.Tags()["histograms"]) == 2


def test_without_tensorboard_the_log_says_so(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with caplog.at_level(logging.INFO, logger="ca_reg.monitor"):
        monitor = make(tmp_path)
    assert monitor.backends == ("jsonl",)
    assert "ca_reg[tensorboard]" in caplog.text
    assert len(run(monitor, 1, 31)) == 3
    assert [file.name for file in tmp_path.iterdir()] == ["ca.jsonl"]


def test_opacities_with_gradients_are_left_alone(tmp_path):
    opacity = OPACITY.clone().requires_grad_()
    with make(tmp_path) as monitor:
        monitor(10, opacity)
    assert opacity.requires_grad
    assert opacity.grad is None


def test_closing_twice_is_fine_and_using_it_then_is_an_error(tmp_path):
    class Closed(Sink):
        count = 0

        def close(self):
            self.count += 1

    with make(tmp_path, sinks=[sink := Closed()]) as monitor:
        monitor.close()
    assert sink.count == 1
    with pytest.raises(ValueError, match="closed"):
        monitor(10, OPACITY)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"views": {}}, ValueError),
        ({"views": {"train": []}}, ValueError),
        ({"views": [1.0]}, TypeError),
        ({"every": 0}, ValueError),
        ({"resume_step": -1}, ValueError),
        ({"psnr": 30.0}, TypeError),
        ({"details": True}, TypeError),
        ({"sinks": [3]}, TypeError),
        ({"sinks": [Sink]}, TypeError),  # the class
        ({"sinks": Sink()}, TypeError),
        ({"sinks": "wandb"}, TypeError),
    ],
)
def test_wrong_arguments_are_refused_before_a_file_is_touched(tmp_path, arguments, error):
    with pytest.raises(error, match="must"):
        make(tmp_path / "new", **arguments)
    assert not (tmp_path / "new").exists()


def test_a_log_of_a_long_seed_is_read(tmp_path):
    with CAMonitor(CAScore(render_fn, seed=2**127 + 1), tmp_path, views=VIEWS, every=10) as monitor:
        monitor(10, OPACITY)
    assert read_dynamics(tmp_path)["seed"] == [2.0**127]


def test_dynamics_are_read_as_columns(tmp_path):
    records = run(make(tmp_path), 1, 31)
    columns = read_dynamics(tmp_path)
    np.testing.assert_array_equal(columns["step"], [10, 20, 30])
    np.testing.assert_array_equal(columns["ca/test"], [record["ca/test"] for record in records])
    assert "ca_reason/test" not in columns
    with pytest.raises(FileNotFoundError, match="CAMonitor"):
        read_dynamics(tmp_path / "nowhere")
    (tmp_path / "ca.jsonl").write_text("")
    with pytest.raises(ValueError, match="no measurement"):
        read_dynamics(tmp_path)


def test_the_figure_shows_both_scores_for_every_run_and_group(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    run(make(tmp_path / "a", psnr=lambda o, v: 20 + v), 1, 31)
    run(make(tmp_path / "b"), 1, 31)
    ca, psnr = plot_dynamics({"baseline": tmp_path / "a", "dropout": tmp_path / "b"})
    assert [line.get_label() for line in ca.lines] == [
        "baseline train",
        "baseline test",
        "dropout train",
        "dropout test",
    ]
    assert [line.get_linestyle() for line in ca.lines] == [":", "-"] * 2
    assert ca.lines[0].get_color() == ca.lines[1].get_color() != ca.lines[2].get_color()
    np.testing.assert_array_equal(ca.lines[1].get_ydata(), read_dynamics(tmp_path / "a")["ca/test"])
    assert [list(line.get_ydata()) for line in psnr.lines] == [[21.5] * 3, [23.0] * 3]
    alone, _ = plot_dynamics(tmp_path / "a", axes=plt.subplots(2)[1])
    assert [line.get_label() for line in alone.lines] == ["train", "test"]
    plt.close("all")


def test_a_full_disk_leaves_whole_lines_and_names_the_log(tmp_path, full_disk):
    monitor = make(tmp_path)
    monitor(10, OPACITY)
    before = (tmp_path / "ca.jsonl").read_bytes()
    with (
        full_disk(len(before) + 20),
        pytest.raises(OSError, match=r"not logged\): '.*ca\.jsonl'$"),
    ):
        monitor(20, OPACITY)
    assert (tmp_path / "ca.jsonl").read_bytes() == before
    monitor(20, OPACITY)  # there is room again
    monitor.close()
    assert [line["step"] for line in lines(tmp_path)] == [10, 20]


def test_a_full_disk_at_the_start_keeps_the_log(tmp_path, full_disk):
    run(make(tmp_path), 1, 31)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with full_disk(20), pytest.raises(OSError, match="too large"):
        make(tmp_path, resume_step=30)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
