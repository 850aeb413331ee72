"""Regularize a training script of the INRIA family without editing it: `python -m ca_reg.integrations.run`.

    python -m ca_reg.integrations.run --dropout 0.2 train.py -s scene -m output --iterations 10000

runs ``train.py`` as Python itself would, with a :class:`~ca_reg.integrations.inria.RasterizerHook` in force, and says
at the end, however that comes about, what was regularized. The options of this launcher stand before the script, all
that follows belongs to the script.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, get_args

from torch import nn

from ca_reg.modules import GaussianDropout, OpacityNoise
from ca_reg.schedules import LinearRamp, Schedule, StartStop

from ._script import run_script, set_command_line
from .inria import RasterizerHook, Scope

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the launcher; what the script raises, its exit code among it, passes through.

    Args:
        arguments: of the launcher, the script and the arguments of the script; those of the process by default.
    """
    options = _parse(arguments)
    hook = None
    if options.regularizers:
        hook = RasterizerHook(nn.Sequential(*options.regularizers), scope=options.scope, seed=options.seed)
    set_command_line(options.script, options.arguments)
    with _reported(options, hook), ExitStack() as undo:
        if options.cpu:
            from reference_trainer.compat import stand_in

            undo.enter_context(stand_in(options.script.resolve().parent, outputs=options.outputs))
        if hook is not None:
            hook.install()  # for as long as the process lives: a script may have wrapped the class once more
        run_script(options.script)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read and check the options before anything runs; `regularizers` is a list of modules."""
    parser = argparse.ArgumentParser(
        prog="python -m ca_reg.integrations.run",
        description="Run a training or render script of the INRIA 3DGS family, regularized, with no edit.",
        usage="%(prog)s [options] script.py [arguments of the script]",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--dropout", type=float, metavar="P", help="share of Gaussians to drop in every training render, e.g. 0.2")
    add("--noise", type=float, metavar="SIGMA", help="standard deviation of the relative opacity noise, e.g. 0.8")
    add("--start", type=int, default=0, metavar="STEP", help="first step that is regularized (default: 0)")
    add("--ramp", type=int, metavar="STEPS", help="raise the rates linearly from 0 over so many steps after --start")
    add("--scope", choices=get_args(Scope), default="main", help="first training render of an iteration, or all")
    add("--seed", type=int, default=0, help="of masks and noise (default: 0); the script's random numbers are its own")
    add("--report", type=Path, metavar="FILE", help="write what was done as JSON, too")
    add("--cpu", action="store_true", help="run without CUDA: a stand-in for the rasterizer of the code base")
    add("--outputs", type=int, choices=(2, 3, 4), help="length of the tuple that the stand-in returns")
    add("script", type=Path, help="train.py or render.py of the code base")
    add("arguments", nargs=argparse.REMAINDER, help="of the script")
    options = parser.parse_args(arguments)
    if not options.script.is_file():
        parser.error(f"there is no script {options.script}")
    if options.report is not None:
        options.report = options.report.absolute()  # the script may change the folder
        if not options.report.parent.is_dir():
            parser.error(f"there is no folder {options.report.parent} for the report")
    if options.outputs is not None and not options.cpu:
        parser.error("--outputs is about the stand-in, which --cpu asks for")
    try:
        options.regularizers = _regularizers(options)
    except ValueError as error:
        parser.error(str(error))
    return options


def _regularizers(options: argparse.Namespace) -> list[nn.Module]:
    """Build what the options ask for, dropout before noise."""

    def scheduled(rate: float) -> Schedule:
        if options.ramp is None:
            return StartStop(rate, start=options.start)
        return LinearRamp(0.0, rate, options.start, options.start + options.ramp)

    modules: list[nn.Module] = []
    if options.dropout is not None:
        GaussianDropout(options.dropout)  # a schedule is checked at its steps only
        modules.append(GaussianDropout(scheduled(options.dropout)))
    if options.noise is not None:
        OpacityNoise(options.noise)
        modules.append(OpacityNoise(scheduled(options.noise)))
    return modules


@contextmanager
def _reported(options: argparse.Namespace, hook: RasterizerHook | None) -> Iterator[None]:
    """Say at the end, whatever it is, what was done."""
    ended = "finished"
    try:
        yield
    except SystemExit as error:
        ended = f"exit {error.code or 0}"
        raise
    except BaseException as error:
        ended = f"{type(error).__name__}: {error}".rstrip(": ")
        raise
    finally:
        report: dict[str, Any] = {
            "script": str(options.script),
            "arguments": options.arguments,
            "dropout": options.dropout,
            "noise": options.noise,
            "start": options.start,
            "ramp": options.ramp,
            "scope": options.scope,
            "seed": options.seed,
            "cpu": options.cpu,
            "ended": ended,
            "renders": None if hook is None else hook.tally.as_dict(),
        }
        lines = ["no regularization was asked for; the script ran plain"] if hook is None else hook.tally.lines()
        for line in [f"{options.script.name}: {ended}", *lines]:
            print(f"[ca_reg] {line}", file=sys.stderr)
        if options.report is not None:
            options.report.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
