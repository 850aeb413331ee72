"""What the command ``ca-reg`` starts: a module of its own, which no folder left by another version can hide."""

import sys
from importlib.util import find_spec

__all__ = ["main"]


def main() -> None:
    """Run `reference_trainer.cli.main`, after a look at what would be imported.

    Earlier versions kept compiled loops among the installed files, where pip leaves them. A folder without an
    ``__init__.py`` is a namespace package to Python, and takes precedence over an editable installation.
    """
    left = [
        folder
        for name in ("ca_reg", "reference_trainer")
        if (spec := find_spec(name)) is not None and spec.origin is None
        for folder in spec.submodule_search_locations or ()
    ]
    if left:
        sys.exit(
            "ca-reg: an older version left files behind that pip does not remove, and they hide this one. Delete: "
            + ", ".join(left)
        )
    from reference_trainer.cli import main as run

    run()
