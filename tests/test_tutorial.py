"""The tutorial, on three photographs of a portal: its commands in order, with fewer steps and smaller pictures."""

import shlex
import shutil

import pytest
from pages import ROOT, blocks

from reference_trainer.cli import main

COMMANDS = "".join(blocks(ROOT / "docs" / "tutorial.md", "bash")).splitlines()
PHOTOGRAPHS = ("0002.jpg", "0004.jpg", "0006.jpg")


@pytest.mark.slow
@pytest.mark.data
def test_the_commands_lead_from_photographs_to_a_page(data_root, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    (tmp_path / "my_photos").mkdir()
    for name in PHOTOGRAPHS:
        shutil.copy(data_root / "herz-jesu" / "images" / name, tmp_path / "my_photos")
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS:
        shorter = command.replace("--iterations 1500", "--iterations 40 --downscale 8 --monitor-every 0")
        main(shlex.split(shorter.replace("--frames 12", "--frames 2"))[1:])
    assert (tmp_path / "my_photos" / "sparse" / "0").is_dir()
    assert "<html" in (tmp_path / "runs" / "report.html").read_text("utf-8")
    assert (tmp_path / "runs" / "mine" / "point_cloud_for_viewers.ply").is_file()
    assert len([*(tmp_path / "runs" / "mine" / "render_flight").iterdir()]) >= 3
