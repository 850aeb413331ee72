"""The command finds this version, or says what hides it."""

import subprocess
import sys

import pytest
from pages import ROOT

# An editable installation as setuptools makes it: a finder that is asked after the folders of the path.
SCRIPT = f"""
import sys
from importlib.machinery import PathFinder

class Editable:
    find_spec = staticmethod(lambda name, path=None, target=None: PathFinder.find_spec(name, path or [{str(ROOT)!r}]))

sys.meta_path.append(Editable)
import ca_reg_command
sys.argv = ["ca-reg", "--help"]
ca_reg_command.main()
"""


def started(site):
    """Start the command with a folder of installed packages in front of the checkout."""
    bare = f"import sys; sys.path[:] = [{str(site)!r}] + [p for p in sys.path if p not in ('', {str(ROOT)!r})]\n"
    command = [sys.executable, "-c", bare + SCRIPT]
    return subprocess.run(command, cwd=site, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("name", ["reference_trainer", "ca_reg"])
def test_what_another_version_left_behind_is_named(tmp_path, name):
    compiled = tmp_path / name / "render" / "__pycache__" / "loops.nbi"
    compiled.parent.mkdir(parents=True)
    compiled.touch()
    refused = started(tmp_path)
    assert refused.returncode == 1
    assert f"Delete: {tmp_path / name}" in refused.stderr
    compiled.unlink()
    for folder in (compiled.parent, compiled.parents[1], compiled.parents[2]):
        folder.rmdir()
    again = started(tmp_path)
    assert again.returncode == 0, again.stderr
    assert "train" in again.stdout
