"""Figures of a comparison: CA and PSNR during training, and one view under every strategy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from torch.nn.functional import pad

from ca_reg.monitor import plot_dynamics
from reference_trainer.evaluation.pictures import PANEL, save_png, side_by_side
from reference_trainer.files import replacing
from reference_trainer.scenes.images import read_image

if TYPE_CHECKING:  # an extra
    from matplotlib.figure import Figure

__all__ = ["comparison_figure", "dynamics_figure", "new_figure"]


@contextmanager
def new_figure(path: Path) -> Iterator[Figure]:
    """Yield an empty figure, and save it on exit in the format of the extension of ``path``, such as PNG or SVG."""
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    yield figure
    with replacing(path) as place:
        figure.savefig(place, dpi=110, format=path.suffix[1:])


def dynamics_figure(runs: Mapping[str, Path], path: Path) -> None:
    """Draw CA and PSNR of several runs against the iteration (paper, training dynamics).

    Args:
        runs: folder of each run by label.
        path: the PNG or SVG to write.
    """
    with new_figure(path) as figure:
        figure.set_size_inches(10, 4.2)
        plot_dynamics(dict(runs), axes=figure.subplots(1, 2))


def comparison_figure(runs: Mapping[str, Path], path: Path, *, view: str, split: str = "test") -> None:
    """Stack the panels (photograph, render, error, CA map) of one view under several strategies.

    Args:
        runs: folder of each run by label.
        path: the PNG to write.
        view: name of the view's files, see `file_names`.
        split: of the view, such as ``"test"``.
    """
    panels = [read_image(folder / "views" / split / f"{view}{PANEL}.png")[0] for folder in runs.values()]
    widest = max(panel.shape[2] for panel in panels)  # long labels widen the panels of narrow pictures
    panels = [pad(panel, (0, widest - panel.shape[2]), value=1.0) for panel in panels]
    save_png(path, side_by_side(panels, list(runs), columns=1))
