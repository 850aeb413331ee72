"""The command line ``ca-reg``."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

try:
    import tyro
except ImportError as error:
    raise SystemExit("ca-reg: the command needs the trainer's packages: pip install 'ca_reg[trainer]'.") from error

from reference_trainer.cli.models import Bake, Clean, Diff, Evaluate, Render, Report, View
from reference_trainer.cli.options import refuse_old_options
from reference_trainer.cli.photos import Run
from reference_trainer.cli.setup import Names, Poses, Recipes, Version, Warmup
from reference_trainer.cli.studies import MOVED, Study
from reference_trainer.cli.training import Compare, Demo, Plan, Train, given_fields
from reference_trainer.devices import check_device
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES, with_recipe

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``ca-reg``; errors that a user can fix exit with one line and code 2, an interruption with 130."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with _log_shown():
        _run(arguments)


def _run(arguments: Sequence[str]) -> None:
    try:
        command = _parse(arguments)
        computing = command.what if isinstance(command, Study) else command
        if hasattr(computing, "check"):
            computing.check()
        if hasattr(computing, "device"):
            check_device(computing.device, here=not (isinstance(command, Compare) and command.elsewhere))
        command()
    except BrokenPipeError:  # the reader of the output, such as head, has stopped reading
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"ca-reg: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("\nca-reg: interrupted; the same command goes on from what is finished.", file=sys.stderr)
        sys.exit(130)


class _Shown(logging.Handler):
    """Shows what happens on the output, tables fitted to the terminal, and warnings on the error output."""

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            print(text, file=sys.stderr, flush=True)
        elif text.startswith("| "):
            from reference_trainer.evaluation.tables import print_table

            print_table(text)
        else:
            print(text, flush=True)


@contextmanager
def _log_shown() -> Iterator[None]:
    """Show the messages of the trainer, and warnings of other packages, while a command runs."""
    root, trainer, shown = logging.getLogger(), logging.getLogger("reference_trainer"), _Shown()
    level = trainer.level
    root.addHandler(shown)
    trainer.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(shown)
        trainer.setLevel(level)


def _parse(arguments: Sequence[str]) -> Any:
    """Return the command with its options; exits if they cannot be parsed."""
    if arguments[:1] == ["study"] and (moved := MOVED.get("".join(arguments[1:2]))):
        raise ValueError(f"study {arguments[1]} is now {moved}, called from a checkout of the repository.")
    usual = TrainConfig()
    refuse_old_options(arguments, [usual.renderer, *(f"--{name}" for name in vars(usual))])
    peek = argparse.ArgumentParser(prog="ca-reg", add_help=False, allow_abbrev=False)
    peek.add_argument("--recipe", choices=list(RECIPES))
    peek.add_argument("--iterations", type=int, default=argparse.SUPPRESS)
    peeked = vars(peek.parse_known_args(arguments)[0])
    recipe, given = peeked.pop("recipe"), given_fields(arguments)
    config = with_recipe(recipe or "3dgs", **({} if recipe else {"iterations": usual.iterations}) | peeked)
    defaults: dict[str, Any] = {
        "demo": Demo(),
        "run": Run(tyro.MISSING),
        "poses": Poses(tyro.MISSING),
        "plan": Plan(config=config, recipe=recipe, given=given),
        "train": Train(config=config, recipe=recipe, given=given),
        "compare": Compare(out=Path("runs/compare"), config=config, recipe=recipe),
        "evaluate": Evaluate(run=tyro.MISSING),
        "report": Report(runs=tyro.MISSING),
        "diff": Diff(tyro.MISSING, tyro.MISSING),
        "view": View(runs=tyro.MISSING),
        "render": Render(run=Path("runs/train")),
        "study": Study(tyro.MISSING),
        "bake": Bake(ply=tyro.MISSING),
        "clean": Clean(ply=tyro.MISSING),
        "names": Names(),
        "recipes": Recipes(),
        "warmup": Warmup(),
        "version": Version(),
    }
    # The list of commands shows the first paragraph of each docstring, the command's own help all of it.
    texts = {name: inspect.getdoc(type(command)) or "" for name, command in defaults.items()}
    short = {name: text.partition("\n\n")[0] for name, text in texts.items() if name not in arguments}
    commands: Any = tyro.extras.subcommand_type_from_defaults(defaults, descriptions=texts | short)
    heard = io.StringIO()
    try:
        with contextlib.redirect_stderr(heard):
            return tyro.cli(
                commands,
                prog="ca-reg",
                description="Measure and remove co-adaptation in sparse-view 3D Gaussian Splatting.",
                args=arguments,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
            )
    except SystemExit:
        # What the options refuse themselves comes in a box with tyro's inner names: say it like all other errors.
        text = " ".join(re.sub(r"[│╭╮╰╯─]", " ", heard.getvalue()).split())
        if found := re.search(r"Error parsing \S+: (.*?) For full helptext", text):
            raise ValueError(found[1]) from None
        sys.stderr.write(heard.getvalue())
        raise
