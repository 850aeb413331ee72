"""A tiny measurement runs and has a row for every size."""

from benchmarks.neighbors import costs


def test_a_row_for_every_size(capsys):
    costs(counts=(50, 60), rounds=1)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["50", "60"]
