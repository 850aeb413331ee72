"""What a monitor writes to sinks, read back from the files of each by other means."""

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from ca_reg import CAMonitor, CAScore
from ca_reg.sinks import MLflowSink, Sink, Sinks, WandbSink

SCRIPT = """
import sys, torch
from ca_reg import CAMonitor, CAScore
from ca_reg.sinks import MLflowSink, WandbSink

folder, kind = sys.argv[1:]
if kind == "wandb":
    sink = WandbSink(project="test", mode="offline", dir=folder)
else:
    import mlflow
    mlflow.set_tracking_uri("file://" + folder + "/mlruns")
    sink = MLflowSink()
details = lambda opacity, view: {"picture": torch.arange(60).reshape(3, 4, 5) / 255, "shares": opacity}
score = CAScore(lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)))
with CAMonitor(score, folder, views={"test": [None]}, every=10, details=details, sinks=[sink]) as monitor:
    monitor.writer.add_text("settings", "dropout: 0.2", 0)
    for step in (10, 20):
        monitor.writer.add_scalar("exact CA (1e-3)/test", step / 8, step)
        monitor(step, torch.linspace(0.1, 0.9, 48))
"""


def logged(folder, kind):
    """Run the script; return what the monitor logged itself."""
    environment = {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "MLFLOW_ALLOW_FILE_STORE": "true"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder), kind], env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in (folder / "ca.jsonl").read_text().splitlines()]


def records_of(content):
    """The records of a file of W&B: LevelDB's log format, blocks of 32 KiB, after a header of 7 bytes."""
    at, parts = 7, b""
    while at + 7 <= len(content):
        if 32768 - at % 32768 < 7:  # the rest of a block is padding
            at += 32768 - at % 32768
            continue
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        parts += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield parts
            parts = b""


class Recorder:
    """A sink of one's own: what it was called with."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *arguments: self.calls.append((name, *arguments))


def test_any_object_with_the_methods_of_a_writer_gets_every_curve(tmp_path):
    sink, other = Recorder(), Recorder()
    score = CAScore(lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)))
    views = {"train": [None], "test": [None]}
    with CAMonitor(score, tmp_path, views=views, every=10, psnr=lambda *_: 20.0, sinks=[sink, other]) as monitor:
        record = monitor(10, torch.linspace(0.1, 0.9, 48))
        monitor.writer.add_scalar("loss", 0.5, 10)
    assert monitor.backends[-2:] == ("Recorder", "Recorder")
    scalars = {call[1]: call[2:] for call in sink.calls if call[0] == "add_scalar"}
    names = ["gaussians", "ca/train", "ca/test", "psnr/train", "psnr/test"]
    assert scalars == {name: (record[name], 10) for name in names} | {"loss": (0.5, 10)}
    assert sink.calls[-1] == ("close",)
    assert sink.calls == other.calls
    with pytest.raises(AttributeError):
        Sinks([sink]).add_video  # noqa: B018


def test_a_step_is_logged_once_though_a_sink_fails(tmp_path):
    class Unreachable(Sink):
        def add_scalar(self, name, value, step):
            raise ConnectionError(name)

    score = CAScore(lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)))
    with CAMonitor(score, tmp_path, views={"test": [None]}, every=10, sinks=[Unreachable()]) as monitor:
        with pytest.raises(ConnectionError):
            monitor(10, torch.ones(48))
        assert monitor(10, torch.ones(48)) is None
    assert len((tmp_path / "ca.jsonl").read_text().splitlines()) == 1


@pytest.mark.parametrize(("kind", "name"), [(WandbSink, "wandb"), (MLflowSink, "mlflow")])
def test_a_sink_whose_library_is_missing_says_what_to_install(kind, name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=f"pip install {name}"):
        kind()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="needs wandb")
def test_the_offline_file_of_wandb_holds_the_curves(tmp_path):
    from wandb.proto.wandb_internal_pb2 import Record

    records = logged(tmp_path, "wandb")
    (path,) = tmp_path.glob("wandb/offline-run-*/*.wandb")
    rows, config = [], {}
    for content in records_of(path.read_bytes()):
        (read := Record()).ParseFromString(content)
        if read.HasField("history"):
            items = {item.key or "/".join(item.nested_key): item.value_json for item in read.history.item}
            rows.append({key: json.loads(value) for key, value in items.items()})
        for item in [*read.config.update, *read.run.config.update]:
            config[item.key or "/".join(item.nested_key)] = json.loads(item.value_json)
    assert config["settings"] == "dropout: 0.2"
    curves = {
        name: {row["step"]: row[name] for row in rows if name in row} for name in ("ca/test", "exact CA (1e-3)/test")
    }
    assert curves == {
        "ca/test": {record["step"]: pytest.approx(record["ca/test"]) for record in records},
        "exact CA (1e-3)/test": {10: 1.25, 20: 2.5},
    }
    assert len(list(tmp_path.glob("wandb/offline-run-*/files/media/images/**/*.png"))) == 2
    assert [sum(row["shares/test/values"]) for row in rows if "shares/test/values" in row] == [48, 48]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mlflow") is None, reason="needs mlflow")
def test_the_files_of_mlflow_hold_the_curves(tmp_path):
    records = logged(tmp_path, "mlflow")
    (run,) = (path.parent for path in tmp_path.glob("mlruns/0/*/metrics"))

    def curve(name):
        lines = (run / "metrics" / name).read_text().splitlines()
        return {int(step): float(value) for _, value, step, *_ in (line.split() for line in lines)}

    assert curve("ca/test") == {record["step"]: pytest.approx(record["ca/test"]) for record in records}
    assert curve("exact CA 1e-3/test") == {10: 1.25, 20: 2.5}
    assert curve("shares/test median") == {10: pytest.approx(0.5, abs=0.01), 20: pytest.approx(0.5, abs=0.01)}
    assert (run / "artifacts" / "settings.txt").read_text() == "dropout: 0.2"
    with Image.open(run / "artifacts" / "images" / "picture" / "test" / "000020.png") as file:
        np.testing.assert_array_equal(np.asarray(file), np.arange(60).reshape(3, 4, 5).transpose(1, 2, 0))
    assert "status: 3" in (run / "meta.yaml").read_text()  # finished
