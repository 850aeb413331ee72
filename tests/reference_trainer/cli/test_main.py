"""What every command has: help, errors in one line, devices, and the ends that it may come to."""

import dataclasses
import io
import os
import re
import shutil
import socket
import subprocess
import sys

import pytest
import torch
from commands import plain, refused

import ca_reg
from reference_trainer import cli
from reference_trainer.cli import main
from reference_trainer.runs import run as run_module
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES, with_recipe


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ([], ["demo", "train", "evaluate", "bake", "render", "compare", "warmup"]),
        (["demo"], ["--iterations", "--seeds", "--jobs", "--out"]),
        (["warmup"], ["--engine", "{None,auto,numba,torch,triton}"]),
        (
            ["train"],
            [
                "--engine",
                "--out",
                "--path",
                "--views",
                "--recipe",
                "--dropout",
                "--noise",
                "--opacity-decay",
                "--monitor-pictures",
                "--viewer",
                "--device",
            ],
        ),
        (["evaluate"], ["--path", "--scene", "--regularizer", "--samples", "--lpips"]),
        (["evaluate"], ["--cameras", "--size", "--world", "--arc", "--background"]),
        (["bake"], ["PATH", "--regularizer", "--out"]),
        (["view"], ["PATH", "--scene", "--arc", "--regularizer", "--port", "--device"]),
        (["render"], ["--what", "--frames", "{auto,test,train,flight,error}"]),
        (
            ["compare"],
            [
                "--strategies",
                "--seeds",
                "--jobs",
                "--iterations",
                "--executor",
                "--engine",
                "--address",
                "--path",
            ],
        ),
    ],
)
def test_help(command, options, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([*command, "--help"])
    assert exit_.value.code == 0
    text = plain(capsys.readouterr().out)
    assert "usage: ca-reg" in text
    for option in options:
        assert option in text


@pytest.mark.parametrize(
    ("command", "named"),
    [("trian", "train"), ("xyzzy", "compare"), ("train synthetic --dropuot 0.2", "--dropout"), ("run", "PATH"),
     ("train --iterations few", "--iterations"), ("train --recipe 3dgz", "3dgs"), ("train --out", "--out"),
     ("run p --from trian", "--from must be one of evaluate, photographs, poses, report, train, got 'trian'."),
     ("train p --engine c", "--engine must be one of auto, numba, torch, triton, got 'c'."),
     ("train p --views few", "--views expects INT: invalid literal"), ("plan p --downscale 0,5", "expects FLOAT:"),
     ("study stabilty", "stability"), ("report", "run"),
     ("run p --frmes 3", "did you mean --frames?"), ("run p --no-auto", "run has no --no-auto, an option of train."),
     ("plan p --monitor-every=0", "plan has no --monitor-every, an option of compare, train."),
     ("plan p --monitor-evry 3", "did you mean --monitor-every, an option of compare, train?"),
     ("clean m.ply --monitor-every 3 --jobs 2", "clean has no --monitor-every, an option of compare, train.")],
)  # fmt: skip
@pytest.mark.parametrize("terminal", [False, True])
def test_a_mistake_is_answered_in_one_line(command, named, terminal, capsys, monkeypatch):
    """With what was meant, and without the help of other commands, whether or not tyro answers in colors."""
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(SystemExit) as exit_:
        main(command.split())
    assert exit_.value.code == 2
    text = capsys.readouterr().err.strip()
    assert text.startswith("ca-reg: ")
    assert named in text
    assert text.isprintable()
    assert len(text) < 250
    assert "tyro" not in text


def test_without_a_command_there_is_help(capsys):
    with pytest.raises(SystemExit) as exit_:
        main([])
    assert exit_.value.code == 0
    assert "compare" in capsys.readouterr().out


def test_settings_given_in_groups_are_those_of_the_training(monkeypatch):
    options = ["--noise", "0.5", "--no-analytic", "--densify-until", "9", "--means-rate=2e-4", "--recipe", "3dgs"]
    command = cli.parse_command(["train", "garden", *options])
    assert command.config == with_recipe("3dgs", noise=0.5, densify_until=9, means_rate=2e-4)
    assert command.folder == "garden"
    assert {"noise", "analytic", "densify_until", "means_rate"} <= command.given


def test_steps_of_a_recipe_scale_however_their_number_is_written():
    asked = with_recipe("fsgs", iterations=2000)
    for written in ("2000", "2_000", "+2000"):
        assert cli.parse_command(["train", "--recipe", "fsgs", "--iterations", written]).config == asked


def test_the_list_of_commands_says_what_each_does(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert len(re.findall(r"• \w+ +\w[^•\n]*\.[ │]*\n", text)) == text.count("•") > 12  # one sentence, one line
    assert "Train the built-in scene" in text
    assert "Finished runs are kept" not in text  # which the help of the command says


def test_version_says_what_a_bug_report_needs(capsys):
    main(["version"])
    lines = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    assert (lines["ca_reg"], lines["torch"]) == (ca_reg.__version__, str(torch.__version__))


def test_help_and_mistakes_need_no_torch():
    code = """if True:
        import contextlib, io, sys
        from reference_trainer.cli import main
        commands = ("demo", "plan", "train", "evaluate", "bake", "render", "view", "compare", "study", "warmup")
        for words in ([], *(command.split() for command in commands), ["train", "--nonsense"]):
            with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()):
                main([*words, "--help"])
        assert "torch" not in sys.modules and "numpy" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("command", ["train", "compare"])
def test_a_card_that_is_not_there(command, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    text = refused([*command.split(), "--device", "cuda"], capsys)
    assert re.fullmatch(r"ca-reg: --device cuda: PyTorch \S+ .*0 CUDA devices; .*cpu\.", text)


@pytest.mark.parametrize("command", ["view a.ply", "train --viewer"])
def test_without_viser(command, capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.ply").touch()
    assert refused(command.split(), capsys).endswith("needs viser: pip install 'ca_reg[viewer]'.")


def test_a_port_that_is_not_free(capsys):
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        text = refused(["train", "--viewer", str(port)], capsys)
    assert re.match(rf"ca-reg: port {port} .*\(.*in use\): give another", text)
    assert "from 0 to 65535, got 65536" in refused(["train", "--viewer", "65536"], capsys)


@pytest.mark.parametrize(
    ("device", "message"),
    [("gpu", "must be cpu, cuda or the number of a card as in cuda:1, got 'gpu'"), ("meta", "cannot compute there"),
     ("cuda:7", "finds 2 CUDA devices"), ("", "must be cpu, cuda")],
)  # fmt: skip
def test_a_device_that_is_none(device, message, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    text = refused(["compare", "--device", device], capsys)
    assert message in text
    assert len(text) < 200


def test_recipes_are_listed(capsys):
    main(["recipes"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == list(RECIPES)
    assert all("Needs" in line and "Differs" in line for line in lines)


# Mistakes end with one line that says what to do, and exit code 2


def test_an_unknown_scene(capsys, tmp_path):
    text = refused(["train", "--path", str(tmp_path / "fren"), "--out", str(tmp_path / "out")], capsys)
    assert re.match(rf"ca-reg: .*no scene folder {re.escape(str(tmp_path / 'fren'))}; .*'synthetic'", text)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--dropout", "1.5"], "dropout must be in [0, 1), got 1.5"),
        (["train", "--sh-every", "-1"], "sh_every must be at least 0, got -1"),
        (["train", "--downscale", "0.5"], "downscale must be a finite number of at least 1, got 0.5"),
        (["compare", "--downscale", "nan"], "downscale must be a finite number of at least 1, got nan"),
        (["train", "--monitor-every", "-1"], "monitor_every must be at least 0"),
        (["compare", "--monitor-every", "-1"], "monitor_every must be at least 0"),
        (["compare", "--seeds", "0"], "at least 1 scene, 1 strategy and 1 seed"),
        (["compare", "--jobs", "0"], "at least 1 job, got 0"),
        (["compare", "--path", "synthetic", "synthetic"], "scenes whose folders have different names"),
        (["compare", "--retries", "-1"], "retries of at least 0"),
        (["compare", "--executor", "processes", "--address", "auto"], "--address auto is that of a Ray cluster"),
        (["evaluate", "nowhere"], "nowhere holds no run: there is no such folder; give the --out folder"),
        (["render", "nowhere"], "nowhere holds no run"),
        (["report", "nowhere", "--out", "."], ". is a folder: --out is the file to write, such as report.html"),
        (["evaluate", "nowhere.ply"], "nowhere.ply"),
        (["evaluate", "a.ply", "--downscale", "8"], "without photographs no option of a scene but --background"),
        (
            ["evaluate", "a.ply", "--scene", "synthetic", "--cameras", "3"],
            "the options of an orbit do not apply",
        ),
        (["evaluate", "a.ply", "--lpips", "installed"], "give --scene"),
        (["evaluate", "run", "--scene", "synthetic"], "run is no PLY, and a run is looked at on its own scene"),
        (["view", "run", "--background", "white"], "run is no PLY, and a run is looked at on its own scene"),
        (["clean", "a.ply", "--views", "3"], "without photographs no option of a scene but --background"),
        (["clean", "a.ply", "--refine", "5"], "--refine 5 needs photographs"),
        (["clean", "a.ply", "--hanging", "--fraction", "0.2"], "leave out --fraction 0.2"),
        (["compare", "--regularizer", "d2gs"], "--strategies says what is compared"),
        (["compare", "--analytic", "--dropout", "0.2"], "--strategies says what is compared"),
        (["evaluate", "a.ply", "--background", "red"], "background must be auto, black or white, got 'red'"),
        (["evaluate", "a.ply", "--size", "0"], "size of at least 1 pixel"),
        (["view", "a.ply", "--arc", "nan"], "an arc in (0, 360] degrees, got cameras=8, size=384 and arc=nan"),
        (["bake", "nowhere.ply"], "there is no file nowhere.ply: expected a standard 3DGS .ply"),
        (["bake", "run"], "run is no PLY: give one, such as the point_cloud.ply of a run"),
        (["clean", "run"], "run is no PLY: give one, such as the point_cloud.ply of a run"),
        (["poses", "nowhere"], "there is no folder nowhere"),
        (["plan", "nowhere"], "there is no scene folder nowhere"),
        (["compare", "nowhere"], "there is no scene folder nowhere"),
        (["warmup", "--engine", "triton"], "the engine triton renders on a card, not on cpu: give --device cuda"),
        (["train", "--regularizer", "dropot(0.2)"], "there is no regularizer 'dropot'; choose one of"),
        (["train", "--loss", "photometric(2.0)"], "lambda_dssim must lie in [0, 1], got 2.0"),
        (["train", "--density", "none"], "there is no density strategy 'none'"),
    ],
)
def test_mistakes(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = refused(arguments, capsys)
    assert text.startswith("ca-reg: ")
    assert message in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--recipe", "gsplat"], "gsplat"),
        (["train", "--recipe", "fsgs", "--iterations", "few"], "few"),
        (["fly"], "fly"),
        (["train", "--dropuot", "0.2"], "--dropuot"),
    ],
)
def test_what_cannot_be_parsed(arguments, message, capsys):
    assert message in refused(arguments, capsys)


def test_an_interruption(monkeypatch, capsys, tmp_path):
    def interrupt(*args, **keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "run_experiment", interrupt)
    with pytest.raises(SystemExit) as exit_:
        main(["train", "--out", str(tmp_path)])
    assert exit_.value.code == 130
    assert "the same command" in capsys.readouterr().err


def test_a_name_that_the_terminal_cannot_show_stops_nothing(monkeypatch):
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="utf-8", errors="strict"))
    with cli.log_shown():
        print("photo\udcff.jpg", flush=True)  # not logged: pytest-xdist cannot pass such a record on
    assert shown.getvalue() == rb"photo\udcff.jpg" + os.linesep.encode()


def test_the_real_arguments_are_the_default(monkeypatch, capsys):
    monkeypatch.setattr(cli.sys, "argv", ["ca-reg", "evaluate", "nowhere"])
    with pytest.raises(SystemExit):
        main()
    assert "nowhere holds no run" in capsys.readouterr().err


@pytest.mark.slow
def test_a_reader_that_has_seen_enough_is_no_error():
    code = "from reference_trainer.cli import main; main(['study', 'error-runtime', '--help'])"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert b"ca-reg:" not in process.stderr.read()


def test_a_mistyped_path_is_answered_before_anything_slow_is_imported():
    code = """if True:
        import contextlib, io, sys
        from reference_trainer.cli import main
        for command in sys.argv[1:]:
            said = io.StringIO()
            try:
                with contextlib.redirect_stderr(said):
                    main(command.split())
            except SystemExit as end:
                assert end.code == 2, command
            assert "typo" in said.getvalue(), command
            assert "torch" not in sys.modules, command
    """
    commands = (
        "evaluate runs/typo", "evaluate typo.ply", "render runs/typo", "report runs/typo", "view runs/typo",
        "bake typo.ply", "clean typo.ply", "train typo", "plan typo", "compare typo", "poses typo", "evaluate typo.pt",
        "study error-runtime typo.ply", "study error-runtime typo",
    )  # fmt: skip
    result = subprocess.run([sys.executable, "-c", code, *commands], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_a_checkpoint_of_another_program_is_no_ply(capsys, tmp_path):
    (tmp_path / "x.pt").touch()
    text = refused(["evaluate", str(tmp_path / "x.pt")], capsys)
    assert "x.pt is neither" in text
    assert "can export" in text


def test_a_folder_of_runs_names_one(capsys, tmp_path):
    run = tmp_path / "baseline" / "seed_0"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")
    shutil.copytree(run, run.with_name("seed_0 copy"))  # made by a file manager, and no seed
    assert f"1 below it: give one, such as {run}" in refused(["render", str(tmp_path)], capsys)


def test_the_options_of_a_training_stand_in_groups(capsys):
    """Every setting once, below a name that says what it is about; texts are paragraphs, whatever their lines."""
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = capsys.readouterr().out
    groups = dict(zip(*[iter(re.split(r" ([\w-]+) options ", text)[1:])] * 2, strict=True))
    told = {"scene": "path", "schedule": "seed", "regularizer": "dropout", "method": "loss", "density": "prune-opacity"}
    for name, option in told.items():
        assert f" --{option} " in groups[name]
    for field in dataclasses.fields(TrainConfig):
        assert len(re.findall(rf"^\W+--{field.name.replace('_', '-')}[ ,]", text, re.M)) == 1
    assert 'split as well; "auto": where' in plain(text)
