import errno
from pathlib import Path

import pytest

from reference_trainer.files import is_ply, remove_leftovers, replacing


def test_the_new_content_replaces_the_old(tmp_path):
    file = tmp_path / "deep" / "er" / "note.txt"
    for text in ("old", "new"):
        with replacing(file) as place:
            place.write_text(text)
            assert place.parent == file.parent  # a move within one file system is atomic
        assert file.read_text() == text
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failure_half_way_changes_nothing(tmp_path, error):
    file = tmp_path / "note.txt"
    file.write_text("old")

    def write_half() -> None:
        with replacing(file) as place:
            place.write_text("ha")
            raise error

    with pytest.raises(type(error)):
        write_half()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_writing_nothing_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "note.txt"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_file_to_write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, "."):
        with pytest.raises(IsADirectoryError, match="is a folder"), replacing(folder):
            pass
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_named_and_keeps_what_was_there(tmp_path, full_disk):
    file = tmp_path / "note.txt"
    file.write_text("old")
    with (
        full_disk(1000),
        pytest.raises(OSError, match=r"\(not written; .*kept\): '.*note\.txt'$") as caught,
        replacing(file) as place,
    ):
        place.write_bytes(bytes(1001))
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(file))
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_an_error_about_another_file_keeps_its_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"directory: '.*other'$"), replacing(tmp_path / "note.txt"):
        (tmp_path / "other").read_text()


def test_a_ply_is_a_file_of_that_name(tmp_path):
    assert is_ply(Path("a.ply"))
    assert is_ply(Path("nowhere", "A.PLY"))
    assert not is_ply(Path("ply"))
    (tmp_path / "run.ply").mkdir()
    assert not is_ply(tmp_path / "run.ply")


def test_leftovers_of_killed_processes(tmp_path):
    keep = [tmp_path / "part", tmp_path / "a.part", tmp_path / ".hidden", tmp_path / "deep"]
    keep[-1].mkdir()
    for path in keep[:-1]:
        path.write_text("mine")
    with replacing(tmp_path / "deep" / "x.png") as place:
        place.write_text("whole")
        (tmp_path / "deep" / place.name.replace("x.png", "y.png")).write_text("ha")  # of a process that is no more
    there = set(tmp_path.rglob("*"))
    for folder, below in ((tmp_path, False), (tmp_path / "nowhere", True)):
        remove_leftovers(folder, below=below)
        assert set(tmp_path.rglob("*")) == there
    remove_leftovers(tmp_path)
    assert set(tmp_path.rglob("*")) == {*keep, tmp_path / "deep" / "x.png"}
