import pytest
from reliability.harness import Settings
from reliability.kill import campaign

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig


@pytest.mark.slow
def test_killed_runs_end_like_the_uninterrupted_one(tmp_path):
    """Two of the many moments that `kill.py` tries; `test_writes.py` chooses what is on the disk by then."""
    config = TrainConfig(
        iterations=20, dropout=0.2, noise=0.3, sh_every=4, densify_from=2, densify_every=4, densify_gradient=2e-3
    )
    settings = Settings(SceneOptions(downscale=8.0), config, monitor_every=3, checkpoint_every=1)
    out = campaign(settings, tmp_path, 2)
    assert out.defects == []
    assert out.kills == 2
    assert out.finished >= 1
