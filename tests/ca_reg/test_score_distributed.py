"""The mean over the views of two processes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import ca_reg
from ca_reg import CAScore

VIEWS = 5
WORKER = """
import json, sys
import torch, torch.distributed as dist
sys.path.insert(0, sys.argv[3])
from test_score_distributed import make_scores, VIEWS
rank, rendezvous = int(sys.argv[1]), sys.argv[2]
dist.init_process_group("gloo", init_method="file://" + rendezvous, rank=rank, world_size=2)
scores = make_scores()
for score in scores:
    for view in range(rank, VIEWS, 2):
        score.update(torch.full((30,), 0.5), view, index=view)
print(json.dumps([score.compute().as_dict() for score in scores]))
dist.destroy_process_group()
"""


def make_scores():
    """One score of every method."""
    colors = torch.rand(3, 30, generator=torch.Generator().manual_seed(0))

    def render_fn(opacity, view):
        # View 1 shows nothing, so that one rank has an empty view.
        alpha = torch.full((4, 4), 0.0 if view == 1 else 1.0)
        return (colors @ opacity)[:, None, None].expand(3, 4, 4) * (view + 1), alpha

    def moments_fn(opacity, view, multiplier, background):
        image, alpha = render_fn(multiplier.mean * opacity, view)
        return {"mean": image, "variance": multiplier.variance * image, "alpha_mean": alpha}

    return [
        CAScore(render_fn),
        CAScore(render_fn, relative_error=0.3),
        CAScore(exact=moments_fn),
        CAScore(exact=moments_fn, neutral=True),
    ]


@pytest.mark.slow
def test_two_ranks_agree_with_one_process(tmp_path):
    alone = make_scores()
    for score in alone:
        for view in range(VIEWS):
            score.update(torch.full((30,), 0.5), view)
    command = [sys.executable, "-c", WORKER]
    root, here = str(Path(ca_reg.__file__).parents[1]), str(Path(__file__).parent)
    ranks = [
        subprocess.Popen([*command, str(rank), str(tmp_path / "rendezvous"), here], stdout=subprocess.PIPE, cwd=root)
        for rank in range(2)
    ]
    summaries = [json.loads(rank.communicate(timeout=60)[0]) for rank in ranks]
    assert summaries[0] == summaries[1]
    for found, score in zip(summaries[0], alone, strict=True):
        expected = score.compute().as_dict()
        assert expected["empty_views"] == 1
        assert (expected["reason"], expected["method"]) == ("OK", score.settings.method)
        for name in ("value", "std_error"):  # the order of the sum differs
            assert found.pop(name) == pytest.approx(expected.pop(name), rel=1e-12)
        assert found == expected
