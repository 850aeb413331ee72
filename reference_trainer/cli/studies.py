"""Studies of trained models. One class per study, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reference_trainer.cli.drawing import Device

__all__ = ["Attribution", "ErrorRuntime", "Stability", "Study"]


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
    device: Device = "cpu"

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.error_runtime import error_runtime_study
        from reference_trainer.studies.study import run_study

        study = error_runtime_study(self.sources, max_samples=self.max_samples, seeds=self.seeds, device=self.device)
        run_study(study, self.out)


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
    device: Device = "cpu"

    def __call__(self) -> None:
        """Run the study."""
        from reference_trainer.studies.gaussian_shares import study_attribution

        study_attribution(self.run, self.out, split=self.split, drop_rate=self.drop_rate, device=self.device)


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
    """Measure something about the method itself."""

    what: ErrorRuntime | Attribution | Stability

    def __call__(self) -> None:
        """Run the study that was chosen."""
        self.what()
