import pytest

from reference_trainer.files import replacing


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
