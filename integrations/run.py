"""Regularize a training script without editing it: `python -m ca_reg.integrations.run`.

    python -m ca_reg.integrations.run --dropout 0.2 train.py -s scene -m output --iterations 10000
    python -m ca_reg.integrations.run --dropout 0.2 simple_trainer.py default --data_dir scene

runs the script as Python itself would, with a :class:`~ca_reg.integrations.inria.RasterizerHook` installed, or, if it
imports gsplat, with :func:`~ca_reg.integrations.gsplat.install`, and reports what was regularized when it ends, in
whatever way. The options of the launcher come before the script, everything after it belongs to the script; ``-m module
arguments...`` runs a module instead.

Python processes that the script starts are hooked, too. The exit code is that of the script, or 1 if the script
succeeded but was not regularized; training that turns out not to be regularized is aborted.
"""

from __future__ import annotations

import argparse
import atexit
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, chdir, contextmanager, suppress
from importlib.util import find_spec
from multiprocessing.util import Finalize, register_after_fork
from pathlib import Path
from typing import Any, get_args

from ca_reg import Chain, GaussianDropout, OpacityNoise
from ca_reg.decay import OpacityDecay
from ca_reg.regularizers import parse
from ca_reg.schedules import LinearRamp, Schedule, StartStop

from ._calls import MODULES, RASTERIZERS
from ._report import Hook
from ._scripts import (
    ScriptAudit,
    explain_download,
    find_script,
    folder_of_reports,
    in_children,
    old_aliases,
    read_script,
    reports_of_children,
    run_script,
    set_command_line,
)  # fmt: skip
from .gsplat import Installation
from .inria import DEFAULT_MODEL, RasterizerHook, Scope, Steps

__all__ = ["main"]

_OF_INRIA = ("scope", "rasterizer", "outputs", "steps", "viewer", "allow_zeros")  # do not apply to gsplat's scripts
_REPORTED = (
    "script", "arguments", "regularizer", "dropout", "noise", "start", "ramp", "opacity_decay", "decay_start", "scope",
    "seed", "cpu",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the launcher with its options, the script and that one's arguments, by default those of the process.

    Exceptions of the script, SystemExit included, pass through.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    options, audit, folder = parse_options(arguments), ScriptAudit(), os.getcwd()
    try:
        _launch(options, arguments, audit)
    except SystemExit as ended:
        if ended.code or options.guard is None:
            raise
    if options.guard is not None:
        _guard(options, audit.saved_ply, folder)


def _launch(options: argparse.Namespace, arguments: Sequence[str], audit: ScriptAudit) -> None:
    """Run the script, hooked, and report how it ended."""
    hook: Hook | None = options.hook
    set_command_line(options.script, options.arguments)
    with ExitStack() as undo:
        if hook is not None:
            # Entered before the report, which reads what these processes have left.
            # A process may run another script; it gets all of the launcher's own options, which stand before this one.
            name = ["-m", options.script] if options.module else [str(options.script.resolve())]
            own = arguments[: len(arguments) - len(options.arguments) - (2 if options.module else 1)]
            undo.enter_context(in_children(f"{__package__}.run:resume", own, name, os.getcwd()))
        undo.enter_context(audit)
        undo.enter_context(old_aliases())
        undo.enter_context(_reported(options, hook, audit))
        if options.cpu:
            from reference_trainer.compat import stand_in

            given = () if options.gsplat else (options.sources.root, options.outputs, options.rasterizer)
            undo.enter_context(stand_in(*given))
        if hook is not None:
            _install(options)
            undo.callback(_uninstall, hook)
        run_script(options.script)


def _guard(options: argparse.Namespace, saved: str | None, folder: str) -> None:
    """Write the model that the script wrote last again, without what hangs where nobody took a photograph.

    A regularizer of one's own is in ``folder``, which the script may have left.
    """
    if saved is None:
        raise SystemExit("[ca_reg] ERROR: --guard: the script was not seen to write a .ply, and nothing was removed.")
    rates = [("dropout", options.dropout), ("noise", options.noise)]
    trained = [options.regularizer, *(f"{name}({rate})" for name, rate in rates if rate is not None)]
    # A process of its own, in which nothing is hooked and no stand-in takes a library's place.
    command = ["-m", "reference_trainer.cli", "clean", saved, "--scene", str(options.guard), "--hanging"]
    command += ["--regularizer", " + ".join(filter(None, trained))]
    code = subprocess.run([sys.executable, *command], cwd=folder, check=False).returncode
    if code:
        raise SystemExit(code)


def resume(arguments: Sequence[str], script: Sequence[str], folder: str) -> None:
    """Hook a process that a launched script has started, and report to the launcher when it ends.

    ``arguments`` are the launcher's options, whose paths and modules are relative to its ``folder``; ``script`` is the
    launched one, or ``-m`` and its module. A script of this process's own takes its place.
    """
    own = Path(sys.argv[0]).absolute()
    this = [str(own)] if own.is_file() else script
    undo = ExitStack()
    undo.enter_context(old_aliases())
    atexit.register(undo.close)  # holds them until the end
    with chdir(folder):
        options = parse_options([*arguments, *this])
    _install(options)
    atexit.register(_leave_report, options.hook, own.name, folder_of_reports())


def _leave_report(hook: Hook, script: str, folder: str) -> None:
    """Report to the launcher what was done in a process that a script has started."""
    if hook.used:  # data loaders, say, render nothing
        found = {"renders": hook.tally.as_dict(), "done": hook.tally.lines(), "problem": hook.problem()}
        path = Path(folder, f"{os.getpid()}.json")
        path.write_text(json.dumps({"script": script, **found}), encoding="utf-8")


def _install(options: argparse.Namespace) -> None:
    """Install the hook, also in what this process forks."""
    options.hook.install()
    script, folder = Path(options.script).name, folder_of_reports()

    def report_at_end(hook: Hook) -> None:
        hook.restart()
        Finalize(None, _leave_report, (hook, script, folder), exitpriority=0)  # a fork ends without atexit

    register_after_fork(options.hook, report_at_end)


def _uninstall(hook: Hook) -> None:
    """Uninstall a hook unless the script has wrapped the class again."""
    with suppress(RuntimeError):
        hook.uninstall()


def parse_options(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse and check the options before anything runs; adds the `hook` that they ask for."""
    parser = argparse.ArgumentParser(
        prog="python -m ca_reg.integrations.run",
        description="Run a training or render script of the INRIA 3DGS family or of gsplat, regularized, with no edit.",
        usage="%(prog)s [options] {script.py | -m module} [arguments of the script]",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--regularizer", default="", metavar="EXPR", help="one or several, such as 'dropout(0.2) + noise(0.8)' or "
        "my_module:MyDropout from the present folder")  # fmt: skip
    add("--dropout", type=float, metavar="P", help="share of Gaussians to drop in every training render, e.g. 0.2")
    add("--noise", type=float, metavar="SIGMA", help="standard deviation of the relative opacity noise, e.g. 0.8")
    add("--start", type=int, default=0, metavar="STEP", help="first step with --dropout and --noise (default: 0)")
    add("--ramp", type=int, metavar="STEPS", help="raise both rates linearly from 0 over so many steps after --start")
    add("--opacity-decay", type=float, metavar="FACTOR", help="multiply all opacities by this after every optimizer "
        "step, e.g. 0.995")  # fmt: skip
    add("--decay-start", type=int, metavar="STEP", help="step after which --opacity-decay begins, best where density "
        "control does (default: 500)")  # fmt: skip
    add("--scope", choices=get_args(Scope), default="main", help="a step's first training render and its batch, or all")
    add("--seed", type=int, default=0, help="of masks and noise (default: 0); the script's random numbers are its own")
    add("--guard", type=Path, metavar="SCENE", help="afterwards write the last .ply again, as *_clean.ply, without "
        "what hangs where no camera of this scene looked (ca_reg[trainer])")  # fmt: skip
    add("--report", type=Path, metavar="FILE", help="write what was done as JSON, too")
    add("--cpu", action="store_true", help="run without CUDA, by a stand-in for the code base's rasterizer or gsplat's")
    add("--rasterizer", metavar="MODULE:CLASS", help="the class that renders, if it is not found in the source")
    add("--outputs", type=lambda text: tuple(text.split(",")), metavar="NAME,...", help="what the stand-in returns, if "
        "the script's names for it do not tell, such as image,radii,depth or image+normal+alpha,radii")  # fmt: skip
    add("--steps", choices=get_args(Steps), help="what tells the steps: calls of update_learning_rate, or changes of "
        "the parameters (default: the former if there is a class with that method)")  # fmt: skip
    add("--viewer", default="MiniCam", metavar="CLASS", help="class of a viewer's cameras (default: MiniCam), or none")
    add("--patience", type=int, default=100, metavar="STEPS", help="end the run after so many steps that were not "
        "regularized (default: 100), or fail at its end; 0 for neither")  # fmt: skip
    add("--allow-zeros", action="store_true", help="opacities of 0 are no dropout of the code base's own")
    add("-m", dest="module", nargs=argparse.REMAINDER, help="run a module as python -m does; all that follows is its")
    # One list: argparse would take a "--" between a script and its arguments for its own.
    add("command", nargs=argparse.REMAINDER, help="train.py or render.py of the code base, and its arguments")
    options = parser.parse_args(arguments)
    command = options.command[options.command[:1] == ["--"] :]
    if options.module is not None:
        if not options.module or command:  # argparse takes -mMODULE without what follows it
            parser.error("-m needs the name of a module, after a space")
        options.script, *options.arguments = options.module
        # Only the package: finding a submodule would import the package, before the hook is installed.
        if find_spec(options.script.partition(".")[0]) is None:
            parser.error(f"there is no module {options.script}")
    elif not command or (script := find_script(Path(command[0]))) is None:
        parser.error(f"there is no script {' '.join(command[:1])}".rstrip())
    elif b"\0" in script.read_bytes():
        parser.error(f"{script} is a program, not a script of Python: name the script itself, without python before it")
    else:
        options.script, options.arguments = script, command[1:]
    options.sources = sources = read_script(options.script)
    options.of_inria = sources.rasterizers or not sources.packages.isdisjoint(MODULES)
    # A rasterizer by name is one of INRIA's: gsplat may be another, optional back end.
    options.gsplat = not options.of_inria and options.rasterizer is None and sources.need("gsplat")
    meaningless = [name for name in _OF_INRIA if getattr(options, name) != parser.get_default(name)]
    if options.gsplat and meaningless:
        parser.error(f"{options.script} is one of gsplat's, for which there is no --{meaningless[0].replace('_', '-')}")
    if options.patience < 0:
        parser.error("--patience must be at least 0")
    if options.report is not None:
        options.report = options.report.absolute()  # the script may change the working directory
        if not options.report.parent.is_dir():
            parser.error(f"there is no folder {options.report.parent} for the report")
    if options.guard is not None:
        options.guard = options.guard.absolute()
        if not options.guard.is_dir():
            parser.error(f"there is no scene {options.guard} for --guard")
        if find_spec("reference_trainer.runs") is None or find_spec("tyro") is None:
            parser.error("--guard needs the trainer: pip install 'ca_reg[trainer]'")
    if options.rasterizer is not None and options.rasterizer.count(":") != 1:
        parser.error(f"--rasterizer must be module:Class, got {options.rasterizer}")
    if options.outputs is not None and not options.cpu:
        parser.error("--outputs is about the stand-in, which --cpu asks for")
    if options.dropout is None and options.noise is None and (options.start or options.ramp is not None):
        parser.error("--start and --ramp are about --dropout and --noise: give --regularizer a schedule of its own")
    if options.decay_start is None:
        options.decay_start = 500
    elif options.opacity_decay is None:
        parser.error("--decay-start is about --opacity-decay")
    try:
        options.hook = _hook(options)
    except (TypeError, ValueError) as error:
        parser.error(str(error))
    if options.hook is None and (options.guard is not None or options.opacity_decay is not None):
        name = "--guard" if options.guard is not None else "--opacity-decay"
        parser.error(f"{name} is for what --dropout, --noise or --regularizer leave: a plain model needs all it has")
    return options


def _hook(options: argparse.Namespace) -> Hook | None:
    """Make the hook that the options ask for; None if they ask for no regularizer."""

    def scheduled(rate: float) -> Schedule:
        if options.ramp is None:
            return StartStop(rate, start=options.start)
        return LinearRamp(0.0, rate, options.start, options.start + options.ramp)

    members = list(parse(options.regularizer))
    for kind, rate in ((GaussianDropout, options.dropout), (OpacityNoise, options.noise)):
        if rate is not None:
            kind(rate)  # checks the rate, which a schedule does only at each step
            members.append(kind(scheduled(rate)))
    decay = None
    if options.opacity_decay is not None:
        decay = OpacityDecay(options.opacity_decay, start=options.decay_start)
    if not members:
        return None
    if options.gsplat:
        return Installation(Chain(*members), seed=options.seed, patience=options.patience, decay=decay)
    return RasterizerHook(
        Chain(*members),
        scope=options.scope,
        seed=options.seed,
        # A script that names none may lack this one: others, which it starts, have theirs.
        rasterizer=options.rasterizer or (None if options.of_inria else RASTERIZERS[0]),
        candidates=options.sources.classes,
        models=dict.fromkeys([DEFAULT_MODEL, *options.sources.models]),
        steps=options.steps or ("updates" if options.sources.models else "parameters"),
        viewer=None if options.viewer == "none" else options.viewer,
        patience=options.patience,
        allow_zeros=options.allow_zeros,
        decay=decay,
    )


@contextmanager
def _reported(options: argparse.Namespace, hook: Hook | None, audit: ScriptAudit) -> Iterator[None]:
    """Report what was done, however the script ends; exit with 1 if that is not what was asked for."""
    ended, problem = "finished", None
    try:
        yield
        problem = _problem(hook)
    except SystemExit as error:
        ended = f"exit {error.code or 0}"
        problem = None if error.code else _problem(hook)
        if not problem:
            raise
    except BaseException as error:
        ended = f"{type(error).__name__}: {error}".rstrip(": ")
        problem = _explain_failure(error, options, audit)
        raise
    finally:
        started = reports_of_children()
        report: dict[str, Any] = {name: getattr(options, name) for name in _REPORTED}
        report |= {"script": str(options.script), "ended": ended, "problem": problem}
        report |= {"renders": None if hook is None else hook.tally.as_dict(), "started": started}
        name = options.script.name if isinstance(options.script, Path) else options.script
        lines = [f"{name}: {ended}"]
        if hook is None:
            lines.append("no regularization was asked for; the script ran plain")
        elif hook.used or not started:
            lines += hook.tally.lines()
        for child in started:
            done = "; ".join(child.get("done", ["nothing"]))
            lines.append(f"{child['script']}, a process that it started: {done}")
        lines += [f"WARNING: a process that it started was not hooked: {command}" for command in audit.missed]
        for line in [*lines, *([f"ERROR: {problem}"] if problem else [])]:
            print(f"[ca_reg] {line}", file=sys.stderr)
        if options.report is not None:
            options.report.write_text(json.dumps(report, indent=2) + "\n")
    if problem:
        raise SystemExit(1)


def _problem(hook: Hook | None) -> str | None:
    """Describe a failure to regularize, in this process or in one that it started; None if there was none."""
    if hook is None:
        return None
    children = reports_of_children()
    own = hook.problem() if hook.used or not children else None
    return own or next((f"{child['script']}: {child['problem']}" for child in children if child["problem"]), None)


def _explain_failure(error: BaseException, options: argparse.Namespace, audit: ScriptAudit) -> str | None:
    """Say what to do about an exception of the script, where the launcher knows."""
    if isinstance(error, ModuleNotFoundError) and options.cpu:
        name = str(error.name)
        renders = name in options.sources.rasterizers or "raster" in name
        named = f"name its class (--rasterizer {name}:CLASS), " if renders else ""
        return (
            f"There is no module {name}: install it, {named}or put a file in its place, beside the script, with what "
            "that calls of it"
        )
    return explain_download(error, options.sources.root.resolve(), audit.saved)


if __name__ == "__main__":
    main()
