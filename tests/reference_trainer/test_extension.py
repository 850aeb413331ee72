"""What it takes to add one of each kind: a file of one's own, and its name. Nothing of the package is edited."""

import json
import sys

import pytest
import torch

from ca_reg.regularizers import REGULARIZERS, parse
from reference_trainer.cli import main
from reference_trainer.runs.run import load_run

# Everything that a user would write; each class with no more than it needs.
TOYS = '''
import torch
from ca_reg import IndependentDropout
from reference_trainer.density import DensityStrategy
from reference_trainer.density.operations import prune
from reference_trainer.losses import LossTerm
from reference_trainer.render import render
from reference_trainer.render.renderers import Renderer


class DropNear(IndependentDropout):
    """Drops Gaussians near the camera, up to the rate p."""

    needs = ("means", "view_matrix")

    def __init__(self, p=0.5):
        super().__init__()
        self.p = p

    def rates(self, x):
        depth = (x.means.detach() @ x.view_matrix[:3, :3].T + x.view_matrix[:3, 3])[:, 2]
        return self.p / (1 + depth.clamp(min=0))


class Flat(LossTerm):
    """Flat Gaussians: the mean of the smallest scale."""

    analytic = True

    def __init__(self, weight=0.1):
        self.weight = weight

    def __call__(self, step):
        return self.weight * step.params.scales.amin(dim=1).mean()


class PruneOnly(DensityStrategy):
    """Removes what is faint, every other step."""

    def before_step(self, optimizer, step):
        if step % 2 == 1:
            prune(optimizer, min_opacity=0.0999)


class Mirrored(Renderer):
    """Draws the picture twice as bright."""

    capabilities = frozenset({"depth"})

    def __call__(self, **arguments):
        out = render(**arguments)
        return out._replace(image=2 * out.image)
'''


@pytest.fixture
def toys(tmp_path, monkeypatch):
    (tmp_path / "toys_of_a_user.py").write_text(TOYS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "toys_of_a_user", raising=False)
    return tmp_path


TRAIN = ["train", "synthetic", "--downscale", "8", "--iterations", "4", "--monitor-every", "0", "--no-auto"]
ADDED = {
    "regularizer": "toys_of_a_user:DropNear(0.9)",
    "loss": "photometric + toys_of_a_user:Flat(1.0)",
    "density": "toys_of_a_user:PruneOnly",
    "renderer": "toys_of_a_user:Mirrored",
}


@pytest.mark.parametrize("kind", ADDED)
def test_one_of_each_kind_is_a_class_in_a_file_of_the_user(kind, toys, capsys):
    losses = {}
    for name, options in (("plain", []), ("toy", [f"--{kind}", ADDED[kind]])):
        main([*TRAIN, "--out", name, *options])
        losses[name] = json.loads((toys / name / "results.json").read_text())
    assert losses["toy"]["config"][kind] == ADDED[kind]
    assert losses["toy"]["mean"]["test"]["psnr"] != losses["plain"]["mean"]["test"]["psnr"]
    assert load_run(toys / "toy").step == 4


@pytest.mark.slow
def test_a_regularizer_of_a_user_is_known_to_every_command(toys, capsys):
    """`compare` in processes of its own, `evaluate` of the run and of its PLY, `bake`."""
    expression = ADDED["regularizer"]
    main(["compare", "--out", "c", *TRAIN[2:-1], "--strategies", "baseline", expression, "--seeds", "1"])
    (run,) = (toys / "c").glob("toys_of_a_user*/seed_0")
    main(["evaluate", str(run), "--samples", "2", "--out", "again"])
    again, before = (json.loads((toys / p).read_text()) for p in ("again/evaluation.json", run / "results.json"))
    assert again["mean"]["test"]["psnr"] == before["mean"]["test"]["psnr"]
    with pytest.raises(SystemExit):  # a file cannot make anybody import a module
        main(["evaluate", str(run / "point_cloud.ply"), "--path", "synthetic", "--downscale", "8"])
    assert "is not imported because a file says so" in capsys.readouterr().err
    main(["evaluate", str(run / "point_cloud.ply"), "--path", "synthetic", "--downscale", "8", "--samples", "2",
          "--regularizer", expression, "--out", "of_ply"])  # fmt: skip
    of_ply = json.loads((toys / "of_ply" / "evaluation.json").read_text())
    assert of_ply["mean"]["test"]["psnr"] == pytest.approx(before["mean"]["test"]["psnr"], abs=1e-3)


def test_rates_of_a_user_follow_the_camera(toys):
    from ca_reg import Params

    means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0], [0.0, 0.0, -3.0]])
    (near,) = parse(ADDED["regularizer"])
    rates = near.rates(Params(torch.ones(3), means=means, view_matrix=torch.eye(4)))
    torch.testing.assert_close(rates, torch.tensor([0.45, 0.18, 0.9]))


def test_every_name_is_listed_with_its_arguments(capsys):
    main(["names", "regularizer"])
    out = capsys.readouterr().out
    assert "--regularizer\n  dropout(p, *, compensate=False)\n      Drop a random subset" in out
    assert "--loss" not in out
    for name in REGULARIZERS:
        assert f"\n  {name}(" in out
