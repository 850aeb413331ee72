"""Progress bars."""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["progress_bar"]


def progress_bar(**options: Any) -> Any:
    """Return tqdm's bar with these options; where no terminal shows it, it writes once a minute.

    Example:
        >>> with progress_bar(total=2, disable=True) as bar:
        ...     _ = bar.update()
    """
    from tqdm import tqdm

    shown = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"  # fits 80 columns
    return tqdm(**{"bar_format": shown, "mininterval": 0.5 if sys.stderr.isatty() else 60.0} | options)
