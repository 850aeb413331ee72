"""Whose code a run may import: that which somebody has named, and no other."""

import json
import shutil

import pytest
import torch

from reference_trainer.runs.folder import CHECKPOINT, CONFIG
from reference_trainer.runs.run import load_run

HIDDEN = {  # all of these are module:Class to Python
    "letters beyond ASCII": "evilmod.\u00c9(0.2)",
    "comments": "(dropout(0.1) # '\n+ evilmod.Evil(0.2) # '\n)",
    "escaped quotes": "dropout('\\'') + evilmod.Evil('\\'')",
}


@pytest.mark.parametrize("place", ["config.json", "checkpoint", "loss", "scene", *HIDDEN])
def test_a_run_imports_no_code_that_nobody_has_named(place, finished, tmp_path, monkeypatch):
    """The module would leave a mark if it were imported."""
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    mark = tmp_path / "mark"
    (tmp_path / "evilmod.py").write_text(f"import pathlib; pathlib.Path({str(mark)!r}).touch()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    claim = json.loads((out / CONFIG).read_text())
    text = {"loss": "photometric + evilmod:Evil", "scene": "evilmod:evil", **HIDDEN}.get(place, "evilmod:Evil(0.2)")
    if place == "checkpoint":
        state = torch.load(out / CHECKPOINT, weights_only=True)
        state["config"] = json.dumps(json.loads(state["config"]) | {"regularizer": text})
        torch.save(state, out / CHECKPOINT)
    else:
        key = {"loss": "loss", "scene": "format"}.get(place, "regularizer")
        claim["scene" if place == "scene" else "config"][key] = text
        (out / CONFIG).write_text(json.dumps(claim))
    with pytest.raises(ValueError, match=r"evilmod, .*not imported.*--trust evilmod"):
        load_run(out)
    assert not mark.exists()
    if place == "checkpoint":
        claim["config"]["regularizer"] = text
        (out / CONFIG).write_text(json.dumps(claim))
        with pytest.raises(ValueError, match="evilmod:Evil cannot be had"):  # there is no such class, but:
            load_run(out, trust=["evilmod"])
        assert mark.exists()
