"""What it takes to add one of each kind: a file of one's own, and its name. Nothing of the package is edited."""

import json
import sys

import pytest
from pages import ROOT, blocks

from ca_reg.regularizers import REGULARIZERS
from reference_trainer.cli import main
from reference_trainer.runs.run import load_run

PAGE = blocks(ROOT / "docs" / "write_your_own.md", "python")
PARTS = {"my_module": PAGE[0], "my_parts": PAGE[2]}


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """The files of docs/write_your_own.md in the present folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name, text in PARTS.items():
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


TRAIN = ["train", "synthetic", "--downscale", "8", "--iterations", "4", "--monitor-every", "0", "--no-auto"]
ADDED = {
    "regularizer": "my_module:MyDropout(0.9)",
    "loss": "photometric + my_parts:Flat(1.0)",
    "density": "my_parts:PruneOnly",
    "renderer": "my_parts:Bright",
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The PSNR without anything of one's own."""
    out = tmp_path_factory.mktemp("plain")
    main([*TRAIN, "--out", str(out)])
    return json.loads((out / "results.json").read_text())["mean"]["test"]["psnr"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ADDED)
def test_one_of_each_kind_is_a_class_in_a_file_of_the_user(kind, parts, plain, capsys):
    main([*TRAIN, "--out", "toy", f"--{kind}", ADDED[kind]])
    results = json.loads((parts / "toy" / "results.json").read_text())
    assert results["config"][kind] == ADDED[kind]
    assert results["mean"]["test"]["psnr"] != plain
    assert load_run(parts / "toy", trust=PARTS).step == 4


@pytest.mark.slow
def test_a_regularizer_of_a_user_is_known_to_every_command(parts, capsys):
    """`compare` in a process of its own, `evaluate` of the run and of its PLY, `bake`."""
    expression = ADDED["regularizer"]
    main(["compare", "--out", "c", *TRAIN[2:-1], "--strategies", expression, "--seeds", "1"])
    (run,) = (parts / "c").glob("my_module*/seed_0")
    main(["evaluate", str(run), "--samples", "2", "--out", "again", "--trust", "my_module"])
    again, before = (json.loads((parts / p).read_text()) for p in ("again/evaluation.json", run / "results.json"))
    assert again["mean"]["test"]["psnr"] == before["mean"]["test"]["psnr"]
    with pytest.raises(SystemExit):  # a folder cannot make anybody import a module
        main(["report", "c"])
    assert "say --trust my_module" in capsys.readouterr().err
    with pytest.raises(SystemExit):  # a file cannot make anybody import a module
        main(["evaluate", str(run / "point_cloud.ply"), "--path", "synthetic", "--downscale", "8"])
    assert "is not imported" in capsys.readouterr().err
    main(["evaluate", str(run / "point_cloud.ply"), "--path", "synthetic", "--downscale", "8", "--samples", "2",
          "--regularizer", expression, "--out", "of_ply"])  # fmt: skip
    of_ply = json.loads((parts / "of_ply" / "evaluation.json").read_text())
    assert of_ply["mean"]["test"]["psnr"] == pytest.approx(before["mean"]["test"]["psnr"], abs=1e-3)


def test_every_name_is_listed_with_its_arguments(capsys):
    main(["names", "regularizer"])
    out = capsys.readouterr().out
    assert "--regularizer\n  dropout(p, *, compensate=False)\n      Drop a random subset" in out
    assert "--loss" not in out
    for name in REGULARIZERS:
        assert f"\n  {name}(" in out
