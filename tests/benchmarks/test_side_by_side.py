"""What the table of other trainers is made with: other seeds, times of steps, and rows of what is finished."""

import json
import random
import sys
import textwrap

import torch

from benchmarks.side_by_side import collect
from benchmarks.timed import main
from benchmarks.trained import table


def test_seeds_are_shifted_and_steps_are_timed(tmp_path, monkeypatch):
    script = """
        import json, pathlib, random, sys, time, torch
        random.seed(5)
        torch.manual_seed(1)
        x = torch.zeros(1, requires_grad=True)
        adam = torch.optim.Adam([x])
        for _ in range(3):
            x.sum().backward()
            adam.step()
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass
        pathlib.Path(sys.argv[1]).write_text(json.dumps([random.random(), torch.rand(1).item()]))
    """
    (tmp_path / "a_trainer.py").write_text(textwrap.dedent(script))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [])
    with torch.random.fork_rng(devices=[]):
        state = random.getstate()
        main(str(tmp_path / "times.json"), "2", "a_trainer", str(tmp_path / "drawn.json"))
        random.setstate(state)
    drawn = json.loads((tmp_path / "drawn.json").read_text())
    assert drawn == [random.Random(7).random(), torch.rand(1, generator=torch.Generator().manual_seed(3)).item()]
    assert 0.04 <= json.loads((tmp_path / "times.json").read_text())["seconds"] < 5  # two steps after the first


def test_rows_are_the_runs_that_are_finished(tmp_path):
    for folder, psnr in (("gsplat/plain/0", 20.0), ("gsplat/plain/1", 22.0), ("ca-reg/dropout/0", 23.0)):
        (tmp_path / folder).mkdir(parents=True)
        kept = {"seed": int(folder[-1]), "psnr": psnr, "ssim": 0.5, "ca": 2e-3, "ca_exact_half": 4e-3,
                "gaussians": 31_000, "seconds_per_iteration": 0.25}  # fmt: skip
        (tmp_path / folder / "kept.json").write_text(json.dumps(kept))
    (tmp_path / "3DGS" / "plain" / "0").mkdir(parents=True)  # not finished
    lines = table(collect(tmp_path)).splitlines()
    assert lines[0].endswith("| Gaussians, k | s/iteration |")
    assert lines[2:] == [
        "| `ca-reg --dropout 0.2` | 1 | 23 | 0.5 | 2 | 4 | 31 | 0.25 |",
        "| `gsplat` | 2 | 21.0 ± 1.4 | 0.5 ± 0 | 2 ± 0 | 4 ± 0 | 31 ± 0 | 0.25 ± 0 |",
    ]
