"""Studies of trained models. One class per study, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

__all__ = [
    "Attribution",
    "ErrorRuntime",
    "Pruning",
    "Ranking",
    "Stability",
    "Study",
]


@dataclass(frozen=True)
class ErrorRuntime:
    """Work-precision diagram: error of every estimator of the score against its run time."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or 3DGS PLY files (seen from an orbit camera)."""
    out: Path = Path("runs/error_runtime")
    """Folder for the JSON, the table and the figure; what was measured is not measured again."""
    max_samples: int = 1024
    """Largest number of renders."""
    seeds: int = 3
    """Independent sequences of masks."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.error_runtime import error_runtime_study
        from reference_trainer.studies.study import run_study

        run_study(
            error_runtime_study(self.sources, max_samples=self.max_samples, seeds=self.seeds, device=self.device),
            self.out,
        )


@dataclass(frozen=True)
class Ranking:
    """How the variants of the score rank the same models: rank correlations, disagreements, and why."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs; those of one scene are compared with each other."""
    out: Path = Path("runs/ranking")
    """Folder for the JSON, the tables and the figure; what was measured is not measured again."""
    split: Literal["test", "train"] = "test"
    """Which views."""
    views: int | None = None
    """Only the first so many."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.ranking import ranking_study
        from reference_trainer.studies.study import run_study

        run_study(ranking_study(self.runs, split=self.split, views=self.views, device=self.device), self.out)


@dataclass(frozen=True)
class Attribution:
    """Which Gaussians hold the co-adaptation: shares of the exact score, as numbers, pictures and a coloured PLY."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    out: Path | None = None
    """Folder for the results; by default <run>/attribution."""
    split: Literal["test", "train"] = "test"
    """Which views."""
    drop_rate: float = 0.5
    """Of the score."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.gaussian_shares import study_attribution

        study_attribution(self.run, self.out, split=self.split, drop_rate=self.drop_rate, device=self.device)


@dataclass(frozen=True)
class Pruning:
    """Prune by the shares and by opacity, equally many Gaussians: test PSNR and co-adaptation of what is left."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs that differ only in their seed."""
    out: Path = Path("runs/pruning")
    """Folder for the JSON, the table and the figure; what was measured is not measured again."""
    fractions: tuple[float, ...] = (0.1, 0.2, 0.4)
    """Parts of the Gaussians to remove."""
    refine: int = 300
    """Steps of further training after pruning, without densification; 0 for none."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.pruning import pruning_study
        from reference_trainer.studies.study import run_study

        run_study(pruning_study(self.runs, fractions=self.fractions, refine=self.refine, device=self.device), self.out)


@dataclass(frozen=True)
class Stability:
    """Extreme cases of both engines against float64 and exact arithmetic: right, refused, or limits, from where on."""

    out: Path = Path("runs/stability")
    """Folder for the JSON, the tables and the picture."""

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.stability.stability_study import study_stability

        study_stability(self.out)


@dataclass(frozen=True)
class Study:
    """Measure something about the method itself; see the subcommands."""

    what: ErrorRuntime | Ranking | Attribution | Pruning | Stability

    def __call__(self) -> None:
        """Run the study that was chosen."""
        self.what()
