"""The folder of a run: where its scene is found."""

import json

import pytest

from reference_trainer.runs.folder import CONFIG, read_run_settings, run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig


@pytest.mark.parametrize(("trained_on", "found"), [
    ("runs/garden/scene/garden", "moved/scene/garden"),  # what `ca-reg run` put into the folder of the run
    ("runs/garden/scene/other", "runs/garden/scene/other"),
    ("photographs/garden", "photographs/garden"),
])  # fmt: skip
def test_a_scene_in_the_folder_of_the_run_is_found_where_that_is_now(trained_on, found, tmp_path):
    (tmp_path / "moved/scene/garden").mkdir(parents=True)
    settings = run_settings(SceneOptions(str(tmp_path / trained_on)), TrainConfig())
    (tmp_path / "moved" / CONFIG).write_text(json.dumps(settings))
    assert read_run_settings(tmp_path / "moved" / CONFIG)[0].path == str(tmp_path / found)
