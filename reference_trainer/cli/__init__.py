"""The command line ``ca-reg``."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tyro

from reference_trainer.cli.drawing import Warmup
from reference_trainer.cli.ply import Bake
from reference_trainer.cli.runs import Compare, Demo, Evaluate, Plan, Render, Train, given_fields
from reference_trainer.cli.studies import Study
from reference_trainer.training.config import PRESETS

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``ca-reg``; errors that a user can mend end with one line and exit code 2, an interruption with 130."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        _parse(arguments)()
    except BrokenPipeError:  # the reader of the output, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"ca-reg: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("\nca-reg: interrupted; the same command continues where it was.", file=sys.stderr)
        sys.exit(130)


def _parse(arguments: Sequence[str]) -> Callable[[], None]:
    """Return the command with its options; exits where they cannot be understood."""
    peek = argparse.ArgumentParser(prog="ca-reg", add_help=False, allow_abbrev=False)
    peek.add_argument("--preset", choices=list(PRESETS), default="fsgs")
    preset = peek.parse_known_args(arguments)[0].preset
    config, given = PRESETS[preset], given_fields(arguments)
    commands: Any = tyro.extras.subcommand_type_from_defaults(
        {
            "demo": Demo(),
            "plan": Plan(config=config, preset=preset, given=given),
            "train": Train(out=Path("runs/train"), config=config, preset=preset, given=given),
            "evaluate": Evaluate(),
            "bake": Bake(ply=tyro.MISSING, dropout=tyro.MISSING),
            "render": Render(run=Path("runs/train")),
            "compare": Compare(out=Path("runs/compare"), config=config, preset=preset),
            "study": Study(tyro.MISSING),
            "warmup": Warmup(),
        },
    )
    command: Callable[[], None] = tyro.cli(
        commands,
        prog="ca-reg",
        description="Measure and remove co-adaptation in sparse-view 3D Gaussian Splatting.",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )
    return command
