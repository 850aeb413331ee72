from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import torch

from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.evaluation.tables import format_mean_std, markdown_table, mean_std, print_table
from reference_trainer.render import describe_engine

NAN = float("nan")


def test_json_round_trip(tmp_path):
    data = {"name": "fern ± é", "n": 3, "ok": True, "none": None, "list": [1.5, [2]], "nested": {"x": 0.1}}
    write_json(tmp_path / "new" / "a.json", data)
    assert json.loads((tmp_path / "new" / "a.json").read_text(encoding="utf-8")) == data
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["a.json"]


def test_json_holds_the_name_of_any_file(tmp_path):
    """Linux takes any bytes, and old archives have names in Latin-1: a training on one ended here, without results."""
    name = b"caf\xe9 \xc3\xa9.jpg".decode(errors="surrogateescape")
    write_json(tmp_path / "a.json", {name: [name]})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {name: [name]}


def test_json_without_numbers_that_it_cannot_hold(tmp_path):
    write_json(tmp_path / "a.json", {"a": NAN, "b": [math.inf, {"c": -math.inf}], "d": (np.float64("nan"), 1)})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": None, "b": [None, {"c": None}], "d": [None, 1]}


@pytest.mark.parametrize("data", [{"x": torch.ones(2)}, {1: "x"}, {"x": {None: 2}}])
def test_json_refuses_the_rest_and_keeps_the_old_file(tmp_path, data):
    write_json(tmp_path / "a.json", [1])
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", data)
    assert json.loads((tmp_path / "a.json").read_text()) == [1]
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_mean_std_equals_numpy():
    values = np.random.default_rng(0).normal(20, 3, 17)
    mean, std = mean_std(values)
    assert mean == pytest.approx(np.mean(values), rel=1e-12)
    assert std == pytest.approx(np.std(values, ddof=1), rel=1e-12)
    assert mean_std([*values, NAN, math.inf]) == (mean, std)


def test_mean_std_of_too_few():
    assert mean_std([5.0])[0] == 5
    assert math.isnan(mean_std([5.0])[1])
    assert all(map(math.isnan, mean_std([NAN])))
    assert all(map(math.isnan, mean_std([])))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([20.39, 20.51, 20.63], "20.51 ± 0.12"),
        ([0.6481, 0.6512, 0.6543], "0.6512 ± 0.0031"),
        ([19_900.0, 20_000.0, 20_100.0], "20000 ± 100"),
        ([1.0 - 0.0999, 1.0, 1.0 + 0.0999], "1.00 ± 0.10"),
        ([10.0 - 9.99, 10.0, 10.0 + 9.99], "10 ± 10"),
        ([2.0, 2.0], "2 ± 0"),
        ([20.51], "20.51"),
        ([12_345.6], "12346"),
        ([], "n/a"),
        ([NAN, NAN], "n/a"),
        ([20.51, NAN], "20.51 (1 of 2)"),
    ],
)
def test_format(values, text):
    assert format_mean_std(values) == text


def test_format_in_thousandths():
    assert format_mean_std([0.00221, 0.00231, 0.00241], unit=1e-3) == "2.31 ± 0.10"
    with pytest.raises(ValueError, match="unit"):
        format_mean_std([1.0], unit=0)


def test_format_takes_a_generator_once():
    assert format_mean_std(x for x in (20.39, 20.51, 20.63)) == "20.51 ± 0.12"


def test_table():
    rows = [{"run": "base|line", "PSNR": 19.3612, "n": 12}, {"run": "x\ny", "PSNR": NAN, "n": None, "other": 1}, {}]
    lines = markdown_table(rows, ["run", "PSNR", "n"]).splitlines()
    assert lines == [
        "| run | PSNR | n |",
        "|:---|---:|---:|",
        "| base\\|line | 19.36 | 12 |",
        "| x y | n/a | n/a |",
        "| n/a | n/a | n/a |",
    ]
    words = markdown_table([{"n": "+1 dB", "why": None}, {"n": "-2", "why": "too few"}, {"n": ""}], ["", "n", "why"])
    assert words.splitlines()[1] == "|:---|---:|:---|"  # words read from the left, figures compare from the right
    with pytest.raises(ValueError, match="column"):
        markdown_table([], [])


def test_machine_can_be_written(tmp_path):
    facts = machine()
    write_json(tmp_path / "a.json", facts)
    assert json.loads((tmp_path / "a.json").read_text()) == facts
    assert facts["torch"] == torch.__version__
    assert facts["threads"] == torch.get_num_threads()
    assert facts["cores"] >= 1
    assert facts["cpu"]


def test_a_measurement_names_the_device_that_made_it(monkeypatch):
    """Of two cards, or the processor beside them; what renders on a card needs none to be named."""
    named = {None: "card 0", "cuda:1": "card 1"}
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: named[device])
    on_card = machine("cuda:1")
    assert (on_card["device"], on_card["engine"]) == ("card 1", describe_engine("cuda"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    on_processor = machine(torch.device("cpu"))
    assert (on_processor["device"], on_processor["engine"]) == ("cpu", describe_engine("cpu"))
    assert machine()["device"] == "card 0"


def test_decimals_are_the_same_down_a_column():
    assert format_mean_std([20.391, 20.51, 20.63], decimals=2) == "20.51 ± 0.12"
    assert format_mean_std([5.0], decimals=2) == "5.00"
    assert format_mean_std([NAN], decimals=2) == "n/a"


NAMES = [f"test quantity {i}" for i in range(12)]
WIDE = markdown_table(
    [
        {"strategy": name, "test PSNR (dB)": f"{20 + row}.00"}
        | {each: f"{row + i:.2f} ± 0.10" for i, each in enumerate(NAMES)}
        for row, name in enumerate(("baseline", "dropout"))
    ],
    ["strategy", *NAMES, "test PSNR (dB)"],
)


@pytest.mark.parametrize("width", [60, 80, 300])
def test_a_table_fits_the_terminal(width, capsys, monkeypatch):
    """Every figure is there and no line is longer; the best strategy is bold."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(width))
    print_table(WIDE)
    out = capsys.readouterr().out
    plain = re.sub(r"\x1b\[[0-9;]*m", "", out)
    assert max(map(len, plain.splitlines())) <= width
    for i in range(12):
        assert f"{i:.2f} ± 0.10" in plain
    assert re.search(r"\x1b\[1m[^\x1b]*21\.00", out)
    assert not re.search(r"\x1b\[1m[^\x1b]*20\.00", out)


@pytest.mark.parametrize("names", [["a", "b"], [f"view {i}" for i in range(20)]])
def test_a_table_of_many_columns_goes_on_below(names, capsys, monkeypatch):
    """Nothing is lost, however many rows there are; every part says which row is which."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    rows = [{"view": name} | {f"quantity{j}": f"{i}.{j:02}" for j in range(30)} for i, name in enumerate(names)]
    print_table(markdown_table(rows, list(rows[0])))
    plain = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, plain.splitlines())) <= 80
    words = plain.split()
    for row in rows:
        assert all(words.count(cell) == 1 for name, cell in row.items() if name != "view")
    if len(names) > 2:
        parts = plain.strip().split("\n\n")
        assert len(parts) > 2
        assert all(re.search("^view 19 ", part, re.M) for part in parts)


def test_a_table_is_markdown_in_a_pipe(capsys):
    print_table(WIDE)
    assert capsys.readouterr().out == WIDE + "\n"
