"""Training, scores and pictures on a device that is not the processor: nothing forgets where it computes."""

import json

import pytest
from tiny import save_few

from reference_trainer.cli import main
from reference_trainer.runs.folder import RESULTS
from reference_trainer.training.trainer import Trainer

TRAIN = (
    "train --downscale 8 --iterations 4 --densify-from 1 --densify-every 2 --opacity-reset-every 0 --no-auto "
    "--dropout 0.2 --device card"
)


@pytest.mark.slow
@pytest.mark.parametrize("options", ["--noise 0.4 --monitor-every 2", "--analytic --monitor-every 0"])
def test_commands(card, tmp_path, options):
    save_few(tmp_path / "start.ply")
    main([*TRAIN.split(), *options.split(), "--init", str(tmp_path / "start.ply"), "--out", str(tmp_path)])
    assert json.loads((tmp_path / RESULTS).read_text())["mean"]["test"]["psnr"] > 15
    main(["render", str(tmp_path), "--device", "card"])
    assert len(list((tmp_path / "render_test").glob("*.png"))) == 3


def test_the_deterministic_switch_reaches_the_device(card, tmp_path, monkeypatch, capsys):
    """With sums as CUDA refuses them there, training is refused: the test above would not have seen them."""
    monkeypatch.setattr("reference_trainer.render.torch.compositing._running", lambda x, product: x.cumsum(-1))
    with pytest.raises(SystemExit):
        main([*TRAIN.split(), "--deterministic", "--monitor-every", "0", "--out", str(tmp_path)])
    assert "cumsum does not" in capsys.readouterr().err


@pytest.mark.parametrize(("first", "then"), [("card", "cpu"), ("cpu", "card")])
def test_a_checkpoint_goes_on_with_any_device(card, tiny_scene, busy, tmp_path, first, then):
    begun = Trainer(tiny_scene, busy, first)
    begun.train(until=4)
    begun.save(tmp_path / "checkpoint.pt")
    trainer = Trainer.load(tmp_path / "checkpoint.pt", tiny_scene, then)
    trainer.train(until=9)
    assert {x.device.type for _, x in trainer.gaussians.named()} == {then}
    assert {x.device.type for x in trainer.density.state_dict().values()} == {then}
