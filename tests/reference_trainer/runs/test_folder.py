"""The folder of a run: where its scene is found."""

import json
import os

import pytest

from reference_trainer.runs.folder import CONFIG, check_output, read_run_settings, report_file, run_settings
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses import LOSSES


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


@pytest.mark.parametrize(("before", "now"), [("runs/a", "b"), ("it's", "Tom's"), ("a", 'Tom\'s "best"')])
def test_models_in_the_folder_of_the_run_are_found_where_that_is_now(before, now, tmp_path):
    def files(run):
        return [f"{tmp_path.as_posix()}/{run}/members/{number}/point_cloud.ply" for number in range(2)]

    (tmp_path / now / "members").mkdir(parents=True)
    loss = f"photometric + distillation({', '.join(map(repr, files(before)))})"
    settings = run_settings(SceneOptions(init=files(before)[0]), TrainConfig(loss=loss))
    (tmp_path / now / CONFIG).write_text(json.dumps(settings))
    options, config = read_run_settings(tmp_path / now / CONFIG)
    assert (options.init, list(LOSSES.make(config.loss)[1].members)) == (files(now)[0], files(now))


def test_where_nothing_can_be_written_is_refused_before_anything_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path / "mine")  # root may write anywhere
    (tmp_path / "mine").mkdir()
    for folder in (tmp_path / "mine", tmp_path / "mine" / "of" / "tomorrow"):
        with pytest.raises(PermissionError, match="another --out"):
            check_output(folder, None, ())
        with pytest.raises(PermissionError, match="another --out"):
            report_file([tmp_path], folder / "report.html")
    check_output(tmp_path / "new", None, ())


def test_the_folder_of_the_photographs_is_no_output(tmp_path):
    (tmp_path / "images_2").mkdir()
    with pytest.raises(ValueError, match="of the scene"):
        check_output(tmp_path / "images_2", tmp_path, ())
    check_output(tmp_path / "runs", tmp_path, ())
