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
from difflib import get_close_matches
from pathlib import Path
from typing import Any

try:
    import tyro
except ImportError as error:
    raise SystemExit("ca-reg: the command needs the trainer's packages: pip install 'ca_reg[trainer]'.") from error

from reference_trainer.cli.listing import registry
from reference_trainer.cli.models import Bake, Clean, Diff, Evaluate, Render, Report, View
from reference_trainer.cli.photos import Run
from reference_trainer.cli.setup import Names, Poses, Recipes, Version, Warmup
from reference_trainer.cli.studies import Study
from reference_trainer.cli.training import Compare, Demo, Plan, Train, given_fields
from reference_trainer.devices import check_device
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES, with_recipe

__all__ = ["log_shown", "main", "parse_command"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``ca-reg``; errors that a user can fix exit with one line and code 2, an interruption with 130."""
    arguments = (sys.argv[1:] if arguments is None else list(arguments)) or ["--help"]
    with log_shown():
        _run(arguments)


def _run(arguments: Sequence[str]) -> None:
    try:
        command = parse_command(arguments)
        if hasattr(command, "check"):  # refuses what cannot work, before anything heavy is imported
            command.check()
        if hasattr(command, "device"):
            check_device(command.device, here=not (isinstance(command, Compare) and command.elsewhere))
        command()
    except BrokenPipeError:  # the reader of the output, such as head, has stopped reading
        # Python flushes the output once more when it exits, which must not fail again.
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
        text, to = record.getMessage(), sys.stderr if record.levelno >= logging.WARNING else sys.stdout
        if text.startswith("| ") and to is sys.stdout:
            from reference_trainer.evaluation.tables import print_table

            print_table(text)
        elif "tqdm" in sys.modules:  # there may be a progress bar, which steps aside
            sys.modules["tqdm"].tqdm.write(text, file=to)
            to.flush()
        else:
            print(text, file=to, flush=True)


@contextmanager
def log_shown() -> Iterator[None]:
    """Show the messages of the trainer, and warnings of other packages, while a command runs."""
    root, trainer, shown = logging.getLogger(), logging.getLogger("reference_trainer"), _Shown()
    level = trainer.level
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of old archives are not all UTF-8, nor is every terminal
        sys.stdout.reconfigure(errors="backslashreplace")
    root.addHandler(shown)
    trainer.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(shown)
        trainer.setLevel(level)


def parse_command(arguments: Sequence[str]) -> Any:
    """Return the command with its options; exits if they cannot be parsed."""
    usual = TrainConfig()
    # The recipe and its length decide on the defaults that tyro shows and fills in: they are read before tyro reads.
    peek = argparse.ArgumentParser(prog="ca-reg", add_help=False, allow_abbrev=False)
    peek.add_argument("--recipe", nargs="?")
    peek.add_argument("--iterations", nargs="?")
    peeked, given = peek.parse_known_args(arguments)[0], given_fields(arguments)
    recipe = peeked.recipe
    if recipe and recipe not in RECIPES:
        raise ValueError(f"there is no recipe {recipe!r}; choose one of {', '.join(RECIPES)}.")
    asked = {} if recipe else {"iterations": usual.iterations}
    with contextlib.suppress(ValueError):  # what is no number tyro refuses
        asked = {"iterations": int(peeked.iterations or "")}
    config = with_recipe(recipe or "3dgs", **asked)
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
            command = tyro.cli(
                commands,
                prog="ca-reg",
                description="Measure and remove co-adaptation in sparse-view 3D Gaussian Splatting.",
                args=arguments,
                registry=registry,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
            )
    except SystemExit as end:
        raise _in_a_line(heard.getvalue(), arguments) or end from None
    return command.what if isinstance(command, Study) else command


def _similar_options(heard: str, given: str) -> dict[str, list[str]]:
    """Return the options that tyro finds similar to a given one, most similar first, with the commands that have them.

    It lists each alike indented, with a line of the box before it or, in ASCII, without; below it, further in, come
    help and commands.
    """
    found: dict[str, list[str]] = {}
    listed: list[str] = []
    sections = re.split(r"Perhaps you meant:|Arguments similar to (?=\S+:)", heard)[1:]
    for line in next((x for x in sections if x.startswith(f"{given}:")), "".join(sections[:1])).splitlines():
        if re.match(r"[│ ] {5}--", line):
            listed = re.findall(r"--[a-z-]+", line)
        elif command := re.search(r" in ca-reg ([a-z]+).* --help", line):
            for option in listed:
                found.setdefault(option, []).append(command[1])
    return found


def _in_a_line(heard: str, arguments: Sequence[str]) -> ValueError | None:
    """Return what tyro says in a box, with inner names and help of other commands, as an error like all others."""
    heard = re.sub(r"\x1b\[[0-9;]*m|\{None\}\|", "", heard)
    text = " ".join(re.sub(r"[│╭╮╰╯─|]|-{3,}", " ", heard).split()).partition(" For full helptext")[0]
    command = next((word for word in arguments if not word.startswith("-")), "")
    if found := re.search(r"Error parsing \S+: (.*?)( Argument helptext: (\S+) (\S+) .*)?$", text):
        # Of an option that has no value by default, tyro first says that what was given is not None.
        why = re.sub(r"^no type matching .*<class '\w+'>: ", "", found[1])
        return ValueError(f"{found[3]} expects {found[4]}: {why}." if found[2] else found[1])
    if found := re.search(r"Unrecognized (?:or misplaced )?options: ([^ ,]+)(?:.*Available subcommands: (.*))?", text):
        given, names = found[1].partition("=")[0], (found[2] or "").split(", ")
        near = _similar_options(heard, given)
        own = [option for option, commands in near.items() if command in commands] or get_close_matches(given, names, 1)
        of = f", an option of {', '.join(near.get(given) or next(iter(near.values()), []))}"
        if given in near:
            return ValueError(f"{command} has no {given}{of}. All options: ca-reg {command} --help")
        meant = f": did you mean {own[0]}?" if own else f": did you mean {next(iter(near))}{of}?" if near else "."
        meant = f": choose one of {found[2]}." if found[2] and not own else meant
        return ValueError(f"there is no {given}{meant} All options: ca-reg {'' if found[2] else f'{command} '}--help")
    if found := re.search(r"Missing from .*?: (\S+) (.*) \(required\)", text):
        return ValueError(f"{command} needs {found[1]}: {found[2]} See ca-reg {command} --help")
    if found := re.search(r"invalid choice (.*?) for argument '(\S+)'. Expected one of \((.*?)\)", text):
        # tyro lists them in another order every time, and a default of None as if it could be written.
        choices = sorted({*re.findall(r"'([^']*)'", found[3])} - {"None"})
        return ValueError(
            f"{found[2]} must be one of {', '.join(choices)}, got {found[1]}. See ca-reg {command} --help"
        )
    text = re.sub(r"^.*?(?=invalid choice|Expected one|Missing value)", "", text)
    return ValueError(f"{text} See ca-reg {command} --help") if heard else None
