"""The recipes of docs/integrations.md that need other packages or CUDA: what can be checked of them without."""

import shlex

import pytest
from pages import ROOT, blocks

from ca_reg.integrations.run import parse_options

PAGE = ROOT / "docs" / "integrations.md"
COMMANDS = [
    shlex.split(line.removeprefix("run "), comments=True)
    for block in blocks(PAGE, "bash")
    for line in block.splitlines()
    if line.startswith("run ")
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_the_launcher_takes_the_commands(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    script = next(word for word in command if word.endswith(".py") or word.startswith("ns-"))
    (tmp_path / script).touch()
    options = parse_options(command)
    assert options.script.name == script
    assert bool(options.hook) == bool({"--dropout", "--noise", "--regularizer"} & {*command})
    assert options.arguments == command[command.index(script) + 1 :]
