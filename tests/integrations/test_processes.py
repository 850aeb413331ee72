"""What a launched script starts and downloads: processes are hooked or named, and a failed download is explained."""

import json
import os
import re
import subprocess
import sys
import textwrap
from urllib.error import URLError

import numpy as np
import pytest
import torch
from launched import FILES
from oracles import random_scene
from stand_ins.gsplat import intrinsics, rasterization

from ca_reg.integrations._scripts import ScriptAudit, in_children
from ca_reg.integrations.run import main

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "OMP_NUM_THREADS": "1"}


@pytest.fixture
def launched(monkeypatch, capfd):
    """The launcher in this process, in a folder of its own, and what it and the processes of its script say.

    That it is a program with an exit code is tested in `test_run.py`.
    """

    def launched(*arguments, cwd, path=()):
        monkeypatch.chdir(cwd)
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*map(str, path), ENVIRONMENT["PYTHONPATH"]]))
        code = 0
        try:
            main([str(x) for x in arguments])
        except SystemExit as ended:
            code = ended.code
        return code, capfd.readouterr().err

    return launched


def run(*arguments, cwd):
    command = [sys.executable, "-m", "ca_reg.integrations.run", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_scripts_that_a_script_starts_are_hooked_and_find_old_names_of_libraries(repository, launched, tmp_path):
    text = (repository / "train.py").read_text()
    (repository / "render.py").write_text(text.replace("range(1, iterations + 1)", "[]"))
    (repository / "train.py").write_text(OLD + text)
    start = """
        import os, subprocess, sys
        os.system(f"{sys.executable} render.py 0")
        subprocess.run([sys.executable, "train.py", "2"], check=True)
    """
    (repository / "both.py").write_text(textwrap.dedent(start))
    report = tmp_path / "report.json"
    code, said = launched("--dropout", 0.5, "--report", report, "both.py", cwd=repository)
    assert code == 0, said
    assert re.search(r"render\.py, .*: 0 renders regularized; 1 renders scaled", said)
    found = {child["script"]: child["renders"]["regularized"] for child in json.loads(report.read_text())["started"]}
    assert found == {"render.py": 0, "train.py": 2}
    assert not {"int", "float"} & set(vars(np))


@pytest.mark.slow
def test_a_command_that_a_script_starts_is_read_itself(repository, launched, tmp_path):
    """Such as ns-train: the script that starts it does not tell what it renders with."""
    (tmp_path / "site").mkdir()
    (repository / "diff_gaussian_rasterization.py").rename(tmp_path / "site" / "their_rasterizer.py")
    renderer = repository / "gaussian_renderer" / "__init__.py"
    renderer.write_text(renderer.read_text().replace("diff_gaussian_rasterization", "their_rasterizer"))
    (repository / "train.py").rename(repository / "their-train")
    (repository / "all.py").write_text('import subprocess, sys\nsubprocess.run([sys.executable, "their-train", "2"])\n')
    _, said = launched("--dropout", 0.5, "all.py", cwd=repository, path=[tmp_path / "site"])
    assert re.search(r"their-train, .*: 2 renders regularized", said)


@pytest.mark.slow
def test_what_forks_of_a_script_did_is_reported(repository, tmp_path):
    """As of the ranks that a script forks; workers of a data loader are forks, too, and render nothing."""
    start = """
        import multiprocessing
        from train import training

        training(1)
        fork = multiprocessing.get_context("fork")
        for target, arguments in [(training, (2,)), (training, (3,)), (print, ())]:
            process = fork.Process(target=target, args=arguments)
            process.start()
            process.join()
    """
    (repository / "both.py").write_text(textwrap.dedent(start))
    done = run("--dropout", 0.5, "--report", tmp_path / "report.json", "both.py", cwd=repository)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["renders"]["regularized"] == 1
    assert sorted(child["renders"]["regularized"] for child in report["started"]) == [2, 3]


@pytest.mark.slow
def test_relative_paths_of_the_options_hold_in_a_process_that_starts_elsewhere(repository, launched, tmp_path):
    (tmp_path / "own_module.py").write_text("from ca_reg import GaussianDropout as Own\n")
    (tmp_path / "garden").mkdir()
    start = f'import subprocess, sys\nsubprocess.run([sys.executable, "train.py", "2"], cwd={str(repository)!r})\n'
    (tmp_path / "all.py").write_text(start)
    options = ("--regularizer", "own_module:Own(0.5)", "--guard", "garden")
    code, _ = launched(*options, "--report", "report.json", "all.py", cwd=tmp_path)
    assert "--guard" in code  # which has no model to clean
    (child,) = json.loads((tmp_path / "report.json").read_text())["started"]
    assert (child["renders"]["regularized"], child["problem"]) == (2, None)


RANKS = """
import torch
import torch.distributed as distributed
import torch.multiprocessing as multiprocessing
from gsplat.rendering import rasterization
from oracles import random_scene
from stand_ins.gsplat import intrinsics

def work(rank, address):
    distributed.init_process_group("gloo", init_method=address, world_size=2, rank=rank)
    scene = random_scene(40, 20, 16, seed=1).to(torch.float32)
    camera = scene.camera.world_to_camera[None], intrinsics(scene.camera)[None], 20, 16
    logits = torch.zeros(40, requires_grad=True)
    info = rasterization(scene.means, scene.quaternions, scene.scales, logits.sigmoid(), scene.colors, *camera)[2]
    torch.save(info["gaussian_ids"], f"seen_{rank}.pt")  # lines that both print can run into each other
    distributed.destroy_process_group()

if __name__ == "__main__":
    multiprocessing.spawn(work, args=("file://PLACE",), nprocs=2)
"""


@pytest.mark.slow
def test_every_rank_of_a_gsplat_trainer_draws_masks_of_its_own(tmp_path):
    pytest.importorskip("gsplat")
    (tmp_path / "trainer.py").write_text(RANKS.replace("PLACE", str(tmp_path / "meeting")))
    done = run("--cpu", "--dropout", 0.5, "--report", tmp_path / "report.json", "trainer.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    scene = random_scene(40, 20, 16, seed=1).to(torch.float32)
    camera = scene.camera.world_to_camera[None], intrinsics(scene.camera)[None], 20, 16
    opacities = torch.full((40,), 0.5)
    info = rasterization(scene.means, scene.quaternions, scene.scales, opacities, scene.colors, *camera)[2]
    visible = set(info["gaussian_ids"].tolist())
    first, second = (set(torch.load(tmp_path / f"seen_{rank}.pt").tolist()) for rank in range(2))
    assert first != second
    assert all(seen < visible and len(seen) < 0.8 * len(visible) for seen in (first, second))
    started = json.loads((tmp_path / "report.json").read_text())["started"]
    assert [child["renders"]["regularized"] for child in started] == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "why"),
    [
        (FILES["train.py"], "not regularized"),  # from step 9 on, which never comes
        ("import torch\ndef render():\n    import diff_gaussian_rasterization as missing\n", "ImportError"),
    ],
    ids=["trains past the hook", "cannot be hooked"],
)
def test_a_process_without_the_regularizer_fails_the_run(repository, launched, script, why):
    (repository / "train.py").write_text(textwrap.dedent(script))
    if why == "ImportError":
        (repository / "diff_gaussian_rasterization.py").unlink()
    start = 'import subprocess, sys\nsubprocess.run([sys.executable, "train.py", "2"])\n'
    (repository / "both.py").write_text(start)
    code, said = launched("--dropout", 0.5, "--start", 9, "both.py", cwd=repository)
    assert code == 1
    assert re.search(rf"ERROR: train\.py: .*{why}", said)


@pytest.mark.parametrize(
    ("command", "changes", "named"),
    [
        (["-I", "-c", "0"], {}, True),
        (["-c", "0"], {"PYTHONPATH": ""}, True),
        (["-c", "0"], {}, False),
        (["-c", "0", "-m", "ca_reg.integrations.run"], {"PYTHONPATH": ""}, False),
    ],
)
def test_a_process_that_cannot_be_hooked_is_named(command, changes, named):
    with in_children("json:dumps", {}), ScriptAudit() as audit:
        subprocess.run(
            [sys.executable, *command], env={**os.environ, **changes}, check=False, stdout=subprocess.DEVNULL
        )
        subprocess.run(["true", "g++", "-I/usr/include/python3.11", "-I/opt", "x.cpp"], check=True)
    assert audit.missed == ([" ".join([sys.executable, *command])] if named else [])


def test_the_last_model_and_the_last_ply_are_noticed(tmp_path):
    with ScriptAudit() as audit:
        for name in ("first.ply", "last.ply", "metrics.npz", "input.ply"):
            (tmp_path / name).write_bytes(b"")
    assert (audit.saved_ply, audit.saved) == (str(tmp_path / "last.ply"), str(tmp_path / "metrics.npz"))


@pytest.mark.parametrize(
    ("option", "first"),
    [
        ("-c", ""),
        ("-c", "import importlib.util; assert importlib.util.find_spec('torch'); "),
        ("-Sc", "import site, sys; del sys.orig_argv; site.main(); "),  # as before Python 3.10
    ],
)
def test_the_first_import_of_torch_is_noticed_and_not_a_search_for_it(tmp_path, option, first):
    (tmp_path / "torch.py").write_text("")
    with in_children("builtins:print", "called"):
        done = subprocess.run(
            [sys.executable, option, first + "import torch"], cwd=tmp_path, capture_output=True, text=True, check=True
        )
    assert done.stdout == "called\n", done.stderr


def test_a_sitecustomize_of_ones_own_still_runs(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.own = 'mine'\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with in_children("json:dumps", {}):
        done = subprocess.run(
            [sys.executable, "-c", "import sys; print(sys.own)"], capture_output=True, text=True, check=False
        )
    assert done.stdout == "mine\n", done.stderr
    assert os.environ["PYTHONPATH"] == str(tmp_path)


DOWNLOAD = """
import urllib.error
from pathlib import Path

def load_weights(url):
    raise urllib.error.URLError("no network")

{save}
load_weights(url="https://example.org/vgg16.pth")
"""


@pytest.mark.parametrize("saves", [True, False])
def test_a_download_of_the_scripts_own_is_explained(repository, tmp_path, capsys, saves):
    model = tmp_path / ("point_cloud.ply" if saves else "input.ply")  # the latter are its initial points
    save = f"Path({str(model)!r}).open('wb').close()"
    (repository / "evaluate.py").write_text(DOWNLOAD.format(save=save))
    with pytest.raises(URLError):
        main([str(repository / "evaluate.py")])
    problem = capsys.readouterr().err.partition("ERROR: ")[2]
    assert "script's own evaluate.py downloads https://example.org/vgg16.pth" in problem
    assert (str(model) in problem) == saves


OLD = """
import torch, matplotlib.cm, numpy as np
assert np.zeros(2, np.int).dtype == int and np.float is float
assert len(matplotlib.cm.get_cmap('viridis', 7).colors) == 7
"""


def test_old_names_of_libraries_are_there_for_a_script(repository):
    (repository / "old.py").write_text(OLD)
    main([str(repository / "old.py")])
