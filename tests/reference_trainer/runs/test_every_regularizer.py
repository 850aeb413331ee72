"""Every regularizer of the registry through the trainer, the checkpoint, the evaluation and the PLY."""

import dataclasses
import math

import pytest
import torch

from ca_reg.regularizers import REGULARIZERS
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.runs.folder import PLY
from reference_trainer.runs.ply import load_ply_model
from reference_trainer.runs.run import Monitoring, load_run, model_of, run_experiment
from reference_trainer.scenes import load_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

EXPRESSIONS = {
    "dropout": "dropout(0.2)",
    "noise": "noise(0.4, scale=True)",
    "drop_gaussian": "drop_gaussian(0.2, 20)",
    "segs": "segs(0.02, 0.005, 0, 20)",
    "clustered": "clustered(0.2)",
    "d2gs": "d2gs(ramp(0.05, 0.3, 0, 20))",
    "depth": "depth(ramp(0.05, 0.3, 0, 20))",
    "drop_anchors": "drop_anchors(ramp(0.0, 0.1, 0, 20))",
    "drop_sh": "drop_sh(until=(5, 10, 20))",
    "position_noise": "position_noise(0.1)",
}
"""Where the name alone lacks arguments, or would do nothing within the 24 steps."""


@pytest.fixture(scope="module")
def config(busy) -> TrainConfig:
    """Everything happens but dropout and noise, and some thousand Gaussians stay some thousand."""
    return dataclasses.replace(busy, dropout=0.0, noise=0.0, densify_gradient=1e-3)


@pytest.fixture(scope="module")
def plain(options, config) -> Gaussians:
    """What the same training makes of the scene without a regularizer."""
    trainer = Trainer(load_scene(options, seed=config.seed), config)
    trainer.train()
    return trainer.gaussians


@pytest.mark.slow
@pytest.mark.parametrize("name", list(REGULARIZERS))
def test_it_trains_is_saved_and_resumed_evaluated_and_named_in_the_ply(name, options, config, plain, tmp_path):
    expression = EXPRESSIONS.get(name, name)
    config = dataclasses.replace(config, regularizer=expression)
    out = tmp_path / "run"
    results = run_experiment(options, config, out, monitoring=Monitoring(12))
    assert math.isfinite(results["mean"]["test"]["psnr"])
    trainer = load_run(out)

    scene = load_scene(options, seed=config.seed)
    first = Trainer(scene, config)
    first.train(until=13)  # clones, splits, pruning and a reset before and after
    first.save(tmp_path / "half.pt")
    resumed = Trainer.load(tmp_path / "half.pt", scene)
    resumed.train()
    straight, halves = (t.optimizer.state_dict() for t in (trainer, resumed))
    for kind in ("gaussians", "moments"):
        assert straight[kind].keys() == halves[kind].keys()
    for parameter, x in straight["gaussians"].items():
        assert torch.equal(x, halves["gaussians"][parameter]), parameter
        for key, moment in straight["moments"][parameter].items():
            assert torch.equal(moment, halves["moments"][parameter][key]), (parameter, key)

    assert not torch.equal(plain.sh_dc, trainer.gaussians.sh_dc), (
        f"{expression} does nothing in {config.iterations} steps: give arguments in EXPRESSIONS"
    )
    for learned in trainer.regularizer.learns:
        x = trainer.gaussians.learned[learned].detach()
        assert len(x) != len(scene.points.positions), "it should have been cloned, split and pruned"
        assert x.unique().numel() > len(x) // 2, "it should have learned"

    model, facts = load_ply_model(out / PLY, background=scene.background)
    assert facts.regularizer == expression
    assert model.step == config.iterations
    for (parameter, x), (_, y) in zip(model.gaussians.named(), trainer.gaussians.named(), strict=True):
        assert torch.equal(x, y), parameter
    with torch.no_grad():
        torch.testing.assert_close(model.test_opacities, model_of(trainer).test_opacities)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*REGULARIZERS, "soft + noise(0.8)"])
def test_it_trains_on_its_expectation_or_says_that_it_has_none(name, options):
    """What it learns included: the expectation has a gradient in it."""
    expression = EXPRESSIONS.get(name, name)
    scene, config = load_scene(options, seed=0), TrainConfig(iterations=3, regularizer=expression, analytic=True)
    sampled = Trainer(scene, dataclasses.replace(config, analytic=False))
    if sampled.regularizer.alpha_factor(sampled.gaussians.params(sampled.views[0].camera)) is None:
        with pytest.raises(ValueError, match=r"analytic .*needs draws"):
            Trainer(scene, config)
        return
    trainer = Trainer(scene, config)
    before = {learned: x.detach().clone() for learned, x in trainer.gaussians.learned.items()}
    trainer.train()
    for learned, x in before.items():
        assert bool((trainer.gaussians.learned[learned] != x).any())
