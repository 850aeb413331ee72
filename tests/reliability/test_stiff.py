import math

import pytest
from reliability.stiff import CASES, push

from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(width=32, height=24, points=150)


SLOW = "densify at every step"


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == SLOW)) for name in CASES])
def test_it_trains_or_stops_with_a_reason_and_a_good_checkpoint(scene, tmp_path, name):
    config = TrainConfig(iterations=24, sh_every=6, densify_from=3, densify_every=4, densify_gradient=1e-4,
                         opacity_reset_from=10, opacity_reset_every=6)  # fmt: skip
    end = push(*CASES[name](scene, config), tmp_path / "checkpoint.pt")
    assert end.gaussians > 0
    assert not math.isnan(end.after)
    if end.reason:
        assert end.step < config.iterations
        assert "lower" in end.reason  # what to do
    else:
        assert end.step == 20  # every tenth is saved


def test_far_too_fast_is_too_fast(scene, tmp_path):
    """The table has both kinds of endings."""
    ends = {name: push(*CASES[name](scene, TrainConfig(iterations=24)), tmp_path / "x.pt") for name in
            ("as it should be", "all learning rates x1e8")}  # fmt: skip
    assert not ends["as it should be"].reason
    assert ends["as it should be"].after > ends["as it should be"].before
    assert "step 2 cannot be rendered: " in ends["all learning rates x1e8"].reason
    assert ends["all learning rates x1e8"].step == 0
