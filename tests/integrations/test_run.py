"""The launcher, on a small code base with the family's layout that is written for the test."""

import json
import os
import re
import subprocess
import sys
import textwrap
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

import pytest
import torch
from launched import draws, launch, seen
from stand_ins.inria import Model, make_rasterizer, make_render
from veils import veiled_at

from ca_reg import Chain
from ca_reg.integrations._scripts import find_script
from ca_reg.integrations.gsplat import Installation
from ca_reg.integrations.inria import RasterizerHook
from ca_reg.integrations.run import main, parse_options
from reference_trainer.evaluation.pictures import save_png
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.scene import Scene
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.model_state import initial_gaussians


def test_a_script_is_regularized_and_the_report_says_how(repository, tmp_path, capsys):
    script, report = repository / "train.py", tmp_path / "report.json"
    assert launch(script, 3) == 0
    plain = capsys.readouterr()
    assert "the script ran plain" in plain.err
    for name in [m for m in sys.modules if m.partition(".")[0] in ("scene", "gaussian_renderer")]:
        del sys.modules[name]
    assert launch("--dropout", 0.5, "--start", 2, "--report", report, script, 3) == 0
    regularized = capsys.readouterr()
    written = json.loads(report.read_text())
    assert written["renders"] == {
        "regularized": 2,
        "scaled": 1,
        "skipped": {"further_view": 3, "rate_zero": 1},
        "first_step": 2,
        "last_step": 3,
        "lost": 0,
        "decayed": 0,
    }
    assert (written["dropout"], written["arguments"], written["ended"]) == (0.5, ["3"], "exit 0")
    assert "[ca_reg] 2 renders regularized, steps 2 to 3" in regularized.err
    assert re.search(r"\[ca_reg\] 3 renders .*: .*another place", regularized.err)
    before, after = seen(plain.out), seen(regularized.out)
    assert after[0] == before[0]
    assert all(a < 0.8 * b for a, b in zip(after[1:], before[1:], strict=True))
    assert draws(plain.out) == draws(regularized.out)  # the script's own random numbers


def test_the_opacities_of_a_script_decay(repository, tmp_path, capsys):
    script, report = repository / "decaying.py", tmp_path / "report.json"
    text = """
        import torch
        from gaussian_renderer import render
        from scene import GaussianModel

        gaussians = GaussianModel()
        before = gaussians.get_opacity.detach().clone()
        optimizer = torch.optim.SGD([{"params": [gaussians._opacity], "name": "opacity"}], lr=0.0)
        for iteration in range(1, 5):
            gaussians.update_learning_rate(iteration)
            render(gaussians.camera, gaussians, None, torch.zeros(3))["render"].sum().backward()
            optimizer.step()
        print("ratios", *(gaussians.get_opacity / before).flatten().tolist())
    """
    script.write_text(textwrap.dedent(text))
    decaying = ["--opacity-decay", "0.9", "--decay-start", "1"]
    main(["--dropout", "0.5", *decaying, "--report", str(report), str(script)])
    out, err = capsys.readouterr()
    assert [float(x) for x in out.split("ratios")[1].split()] == pytest.approx(
        [0.9**3] * len(out.split()[1:]), rel=1e-5
    )
    assert "decayed after 3 optimizer steps" in err
    written = json.loads(report.read_text())
    assert (written["opacity_decay"], written["decay_start"], written["renders"]["decayed"]) == (0.9, 1, 3)


def test_a_users_own_regularizer_from_the_present_folder(repository, my_module, tmp_path, capsys):
    own, report = "my_module:MyDropout(0.8) + my_module:MyScaleNoise(0.0) + noise(0.5)", tmp_path / "report.json"
    assert launch("--regularizer", own, "--seed", 4, "--report", report, repository / "train.py", 2) == 0
    written = json.loads(report.read_text())
    assert (written["regularizer"], written["renders"]["regularized"], written["renders"]["scaled"]) == (own, 2, 1)
    rasterizer, model, counts = make_rasterizer(), Model(), []
    dropout = my_module.MyDropout(0.8)
    with RasterizerHook(Chain(dropout), rasterizer=rasterizer, seed=4) as hook:
        for step in (1, 2):
            hook.step(step)
            radii = make_render(rasterizer)(model.camera, model, None, torch.zeros(3))["radii"]
            counts.append(int((radii > 0).sum()))
            assert 0 < dropout.keep.sum() < len(radii)
    assert seen(capsys.readouterr().out) == counts


def test_the_script_sees_what_python_would_show_it(repository, capsys):
    script = repository / "train.py"
    for own in ([1, "--seed", 7, "--dropout", "theirs"], ["--", 1], ["-m", 1]):
        with suppress(ValueError):  # of the last two, whose first argument is no number
            launch("--seed", 4, "--scope", "all", script, *own)
        line = capsys.readouterr().out.splitlines()[0]
        assert line == f"argv {[*map(str, own)]} path {repository} file {script}"


def test_a_ramp_and_noise(repository, tmp_path, capsys):
    report = tmp_path / "report.json"
    launch("--noise", 0.8, "--ramp", 10, "--scope", "all", "--report", report, repository / "train.py", 2)
    assert json.loads(report.read_text())["renders"]["regularized"] == 4


@pytest.mark.parametrize(
    ("flag", "error", "ended"),
    [
        ("--fail", ValueError, "ValueError: a failure of their own"),
        ("--interrupt", KeyboardInterrupt, "KeyboardInterrupt"),
        ("--exit", SystemExit, "exit 3"),
    ],
)
def test_the_report_comes_however_the_script_ends(repository, tmp_path, capsys, flag, error, ended):
    report = tmp_path / "report.json"
    with pytest.raises(error) as raised:
        main(["--dropout", "0.5", "--report", str(report), str(repository / "train.py"), "1", flag])
    assert getattr(raised.value, "code", 3) == 3
    assert json.loads(report.read_text())["ended"] == ended
    assert "1 renders regularized" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "offered"), [("my_rasterization", True), ("websockets_of_mine", False)])
def test_a_missing_extension_is_named_with_the_ways_out(repository, capsys, name, offered):
    (repository / "train.py").write_text(f"import {name}\n")
    with pytest.raises(ModuleNotFoundError):
        main(["--cpu", str(repository / "train.py")])
    problem = capsys.readouterr().err.partition("ERROR: ")[2]
    assert f"no module {name}: install it" in problem
    assert (f"--rasterizer {name}:CLASS" in problem) == offered  # for what may rasterize


@pytest.mark.parametrize("installed", [True, False])  # a script may start others, which bring theirs
def test_a_script_that_does_not_render_is_an_error(repository, tmp_path, capsys, installed):
    (repository / "other.py").write_text("print('done')\n")
    if not installed:
        (repository / "diff_gaussian_rasterization.py").unlink()
    report = tmp_path / "report.json"
    assert launch("--dropout", 0.2, "--report", report, repository / "other.py") == 1
    err = capsys.readouterr().err
    assert "NOTHING was regularized" in err
    assert re.search("ERROR: No render .*nothing.*--patience", err)
    assert json.loads(report.read_text())["problem"].startswith("No render was")


def test_a_script_that_renders_for_tests_alone_is_none(repository, capsys):
    text = (repository / "train.py").read_text().replace("range(1, iterations + 1)", "[]")
    (repository / "render.py").write_text(text)
    for regularizer in (("--dropout", 0.2), ("--noise", 0.8)):
        assert launch(*regularizer, repository / "render.py", 0) == 0
        for name in [m for m in sys.modules if m.partition(".")[0] in ("scene", "gaussian_renderer")]:
            del sys.modules[name]


OTHER_RASTERIZER = """
import torch
from scene import GaussianModel
from stand_ins.inria import make_rasterizer, make_render

import diff_gaussian_rasterization

render, gaussians = make_render(make_rasterizer()), GaussianModel()
optimizer = torch.optim.SGD([{"params": [gaussians._opacity], "name": "opacity"}], lr=0.1)
for iteration in range(1, 31):
    gaussians.update_learning_rate(iteration)
    render(gaussians.camera, gaussians, None, torch.zeros(3))["render"].sum().backward()
    optimizer.step()
    print("step", iteration)
"""


def test_a_training_with_another_rasterizer_is_ended_early(repository, capsys):
    (repository / "other.py").write_text(OTHER_RASTERIZER)
    with pytest.raises(RuntimeError, match="6 optimizer steps"):
        main(["--dropout", "0.2", "--patience", "5", str(repository / "other.py")])
    assert capsys.readouterr().out.split()[-1] == "5"


def test_a_short_one_fails_at_its_end(repository, capsys):
    (repository / "other.py").write_text(OTHER_RASTERIZER)
    assert launch("--dropout", "0.2", repository / "other.py") == 1
    captured = capsys.readouterr()
    assert captured.out.split()[-1] == "30"
    assert re.search(r"ERROR: .*not regularized\. .*\S+GaussianRasterizer;", captured.err)


def test_a_schedule_that_never_begins_is_an_error(repository, capsys):
    assert launch("--dropout", 0.2, "--start", 9, repository / "train.py", 3) == 1
    assert re.search("ERROR: .*not regularized.*--start", capsys.readouterr().err)


def test_a_module_runs_as_python_would_run_it(repository, capsys, monkeypatch):
    monkeypatch.chdir(repository)
    (repository / "package").mkdir()
    (repository / "package" / "train.py").write_text((repository / "train.py").read_text())
    sys.path.insert(0, "")
    assert launch("--dropout", 0.5, "-m", "package.train", 2, "--dropout") == 0
    captured = capsys.readouterr()
    path = repository / "package" / "train.py"
    assert captured.out.splitlines()[0] == f"argv ['2', '--dropout'] path {repository} file {path}"
    assert "[ca_reg] package.train: exit 0\n[ca_reg] 2 renders regularized" in captured.err


SPAWNING = """
import multiprocessing

import torch

{imports}

def work(queue):
    queue.put({call}.device.type)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    worker = context.Process(target=work, args=(queue,))
    worker.start()
    worker.join()
    print(worker.exitcode, "nothing" if queue.empty() else queue.get())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("imports", "call"),
    [
        ("import gaussian_renderer", "gaussian_renderer.distCUDA2(torch.rand(9, 3, device='cuda'))"),
        ("import gsplat, fused_ssim", "fused_ssim.fused_ssim(*torch.rand(2, 1, 3, 12, 12, device='cuda'))"),
    ],
)
def test_workers_that_start_afresh_find_the_stand_ins(repository, imports, call):
    """As those of data loaders do on macOS and Windows: nothing but the search path is handed on."""
    (repository / "diff_gaussian_rasterization.py").unlink()
    (repository / "gaussian_renderer" / "__init__.py").write_text(
        "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
        "from simple_knn._C import distCUDA2\n"
        "def render(settings, x):\n"
        "    rasterizer = GaussianRasterizer(raster_settings=settings)\n"
        "    image, radii = rasterizer(means3D=x)\n"
    )
    (repository / "train.py").write_text(SPAWNING.format(imports=imports, call=call))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "ca_reg.integrations.run", "--cpu", "train.py"]
    done = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["0", "cpu"], done.stderr
    assert "Traceback" not in done.stderr  # the stand-ins end before the interpreter does


def test_without_cuda_the_stand_in_comes_first(repository, capsys, monkeypatch):
    asked = []

    @contextmanager
    def stand_in(repository: Path, outputs=None, rasterizer=None):
        asked.append((repository, outputs, rasterizer))
        from stand_ins.inria import make_rasterizer

        module = ModuleType("diff_gaussian_rasterization")
        module.GaussianRasterizer = make_rasterizer("plain")
        sys.modules[module.__name__] = module
        try:
            yield (module.__name__,)
        finally:
            del sys.modules[module.__name__]

    fake = ModuleType("reference_trainer.compat")
    fake.stand_in = stand_in
    monkeypatch.setitem(sys.modules, "reference_trainer.compat", fake)
    (repository / "diff_gaussian_rasterization.py").unlink()
    assert launch("--cpu", "--outputs", "image,radii", "--dropout", 0.5, repository / "train.py", 1) == 0
    assert asked == [(repository, ("image", "radii"), None)]
    assert "1 renders regularized" in capsys.readouterr().err


OF_GSPLAT = """
import sys

import torch
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from oracles import random_scene
from stand_ins.gsplat import intrinsics

def main(local_rank, world_rank, world_size, steps):
    scene = random_scene(40, 20, 16, seed=1).to(torch.float32)
    means, logits = scene.means.to(f"cuda:{local_rank}").requires_grad_(), torch.zeros(40, requires_grad=True)
    optimizer = torch.optim.SGD([{"params": [logits], "name": "opacities"}], lr=0.1)

    def render():
        camera = scene.camera.world_to_camera[None], intrinsics(scene.camera)[None], 20, 16
        return rasterization(means, scene.quaternions, scene.scales, logits.sigmoid(), scene.colors, *camera)

    for step in range(steps):
        image, _, info = render()
        image.sum().backward()
        optimizer.step()
        print("seen", len(info["gaussian_ids"]), torch.rand(1).item())
    with torch.no_grad():
        render()

torch.manual_seed(0)
cli(main, int(sys.argv[1]))
"""


def test_a_script_that_calls_gsplat_is_told_from_the_others(tmp_path, capsys, repository):
    pytest.importorskip("gsplat")
    script, report = tmp_path / "trainer.py", tmp_path / "report.json"
    script.write_text(OF_GSPLAT)
    main(["--cpu", str(script), "3"])
    plain = capsys.readouterr().out
    main(["--cpu", "--dropout", "0.5", "--report", str(report), str(script), "3"])
    regularized = capsys.readouterr()
    assert json.loads(report.read_text())["renders"] | {"skipped": {}} == {
        "regularized": 3,
        "scaled": 1,
        "skipped": {},
        "first_step": 0,
        "last_step": 2,
        "lost": 0,
        "decayed": 0,
    }
    assert all(a < 0.8 * b for a, b in zip(seen(regularized.out), seen(plain), strict=True))
    assert draws(plain) == draws(regularized.out)
    assert launch("--scope", "all", "--dropout", 0.5, script) == 2
    assert "no --scope" in capsys.readouterr().err


def test_with_a_rasterizer_by_name_gsplat_is_an_optional_back_end(tmp_path):
    script = tmp_path / "train.py"
    script.write_text("try:\n    import gsplat\nexcept ImportError:\n    gsplat = None\n")
    options = parse_options(["--dropout", "0.2", "--rasterizer", "mine:Rasterizer", str(script)])
    assert isinstance(options.hook, RasterizerHook)
    assert isinstance(parse_options(["--dropout", "0.2", str(script)]).hook, Installation)


def test_an_installed_command_is_a_script_as_well(tmp_path, monkeypatch):
    assert find_script(Path("pytest")).read_text().startswith("#!")
    assert find_script(Path("no-such-command")) is None
    (tmp_path / "pytest").write_text("print()")
    monkeypatch.chdir(tmp_path)
    assert find_script(Path("pytest")) == Path("pytest")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.py"], "there is no script nowhere.py"),
        ([], "there is no script"),
        ([sys.executable, "SCRIPT"], "is a program, not a script of Python"),
        (["-m"], "-m needs the name of a module"),
        (["-mos", "1"], "-m needs the name of a module"),
        (["-m", "nowhere.train"], "there is no module nowhere.train"),
        (["--patience", "-1", "SCRIPT"], "--patience must be at least 0"),
        (["--rasterizer", "Mine", "SCRIPT"], "--rasterizer must be module:Class, got Mine"),
        (["--regularizer", "dropout(1.5)", "SCRIPT"], r"p must be in \[0, 1\)"),
        (["--regularizer", "nowhere:Mine", "SCRIPT"], "the regularizer nowhere:Mine cannot be had"),
        (["--dropout", "1.5", "SCRIPT"], r"p must be in \[0, 1\)"),
        (["--noise", "-1", "SCRIPT"], "sigma must be finite and at least 0"),
        (["--dropout", "0.2", "--ramp", "0", "SCRIPT"], "end_step must come after start_step"),
        (
            ["--regularizer", "dropout(0.2)", "--ramp", "9", "SCRIPT"],
            "--start and --ramp are about --dropout and --noise",
        ),
        (["--dropout", "0.2", "--seed", "-1", "SCRIPT"], "seed must be at least 0"),
        (["--outputs", "2", "SCRIPT"], "which --cpu asks for"),
        (["--report", "nowhere/x.json", "SCRIPT"], "there is no folder"),
        (["--dropout", "0.2", "--guard", "nowhere", "SCRIPT"], "there is no scene .*nowhere for --guard"),
        (["--guard", ".", "SCRIPT"], "--guard is .* a plain model needs all it has"),
        (["--opacity-decay", "0.995", "SCRIPT"], "--opacity-decay is for"),
        (["--dropout", "0.2", "--decay-start", "9", "SCRIPT"], "--decay-start is"),
        (["--dropout", "0.2", "--opacity-decay", "1.5", "SCRIPT"], r"factor must be in \(0, 1\]"),
        (["--dropout", "0.2", "--opacity-decay", "0.9", "--decay-start", "-1", "SCRIPT"], "start must be at least 0"),
        (["--drop", "0.2", "SCRIPT"], "unrecognized arguments|no script"),
    ],
)
def test_wrong_options_are_refused_before_anything_runs(repository, capsys, arguments, message):
    code = launch(*[str(repository / "train.py") if x == "SCRIPT" else x for x in arguments])
    captured = capsys.readouterr()
    assert code == 2
    assert captured.out == ""
    assert re.search(message, captured.err)


def write_scene(folder: Path, scene: Scene) -> None:
    """Write the training views as nerfstudio does: photographs, and a transforms.json with OpenGL's axes."""
    frames = []
    for view in scene.train:
        save_png(folder / "images" / f"{view.name}.png", view.image)
        pose = torch.linalg.inv(view.camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": pose.tolist()})
    camera = scene.train[0].camera
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    size = {"w": camera.width, "h": camera.height}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | size | {"frames": frames}))


@pytest.mark.slow
def test_a_guarded_model_is_written_again_without_what_hangs(repository, tmp_path, monkeypatch):
    """The script writes two models and leaves its folder, with the regularizer's: the later model is cleaned."""
    scene, work = synthetic_scene(width=48, height=36, points=400), tmp_path / "work"
    write_scene(tmp_path / "scene", scene)
    start = initial_gaussians(scene, TrainConfig())
    beyond = [view.camera for view in unseen_views(scene) if view.name.startswith("beyond train_0")]
    both, veil = veiled_at(beyond, start, more=3.0)
    save_ply(both, tmp_path / "trained.ply")
    script, trained = repository / "train.py", str(tmp_path / "trained.ply")
    saves = f"""    for name in ("first.ply", "last.ply"):
        with open(name, "wb") as out, open({trained!r}, "rb") as model:
            out.write(model.read())
    __import__("os").chdir("/")
    sys.exit("""
    script.write_text(script.read_text().replace("    sys.exit(", saves))
    work.mkdir()
    (work / "my_guarded.py").write_text("from ca_reg import GaussianDropout as Own\n")
    monkeypatch.chdir(work)
    options = ("--regularizer", "my_guarded:Own(0.1)", "--dropout", 0.2, "--guard", tmp_path / "scene")
    main([str(x) for x in (*options, script, 1)])
    assert sorted(path.name for path in work.glob("*.ply")) == ["first.ply", "last.ply", "last_clean.ply"]
    cleaned = load_ply(work / "last_clean.ply")
    assert cleaned.regularizer == "my_guarded:Own(0.1) + dropout(0.2)"
    left = {tuple(row) for row in cleaned.gaussians.means.tolist()}
    assert {tuple(row) for row in start.means.tolist()} <= left
    assert sum(tuple(row) in left for row in veil.means.tolist()) < len(beyond)


def test_a_guard_without_a_model_is_an_error(repository, tmp_path):
    assert "--guard" in launch("--dropout", 0.5, "--guard", tmp_path, repository / "train.py", 1)


@pytest.mark.slow
def test_the_module_is_a_program_whose_exit_code_is_the_scripts(repository):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "ca_reg.integrations.run", "--dropout", "0.5", "train.py", "1", "--exit"]
    done = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert f"argv ['1', '--exit'] path {repository}" in done.stdout
    assert "1 renders regularized, steps 1 to 1" in done.stderr
