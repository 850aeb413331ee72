"""Studies of trained models. One class per study, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

__all__ = ["ErrorRuntime", "Ranking", "Study"]


@dataclass(frozen=True)
class ErrorRuntime:
    """Work-precision diagram: error of every estimator of the score against its run time."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or 3DGS PLY files (seen from an orbit camera)."""
    out: Path = Path("runs/error_runtime")
    """Folder for the JSON, the table and the figure; what is in it is not measured again."""
    max_samples: int = 1024
    """Largest number of renders."""
    seeds: int = 3
    """Independent sequences of masks."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.error_runtime_study import study_error_runtime

        study_error_runtime(
            self.sources, self.out, max_samples=self.max_samples, seeds=self.seeds, device=self.device, say=print
        )


@dataclass(frozen=True)
class Ranking:
    """How the variants of the score rank the same models: rank correlations, disagreements, and why."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs; those of one scene are compared with each other."""
    out: Path = Path("runs/ranking")
    """Folder for the JSON, the tables and the figure; what is in it is not measured again."""
    split: Literal["test", "train"] = "test"
    """Which views."""
    views: int | None = None
    """Only the first so many."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.ranking import study_ranking

        study_ranking(self.runs, self.out, split=self.split, views=self.views, device=self.device, say=print)


@dataclass(frozen=True)
class Study:
    """Measure something about the method itself; see the subcommands."""

    what: ErrorRuntime | Ranking

    def __call__(self) -> None:
        """Run the study that was chosen."""
        self.what()
