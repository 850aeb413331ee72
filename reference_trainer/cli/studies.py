"""Studies of the method and of trained models: one class per study, whose fields are its options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from reference_trainer.cli.options import Device, Trust, check_model
from reference_trainer.files import is_ply
from reference_trainer.scenes.options import OrbitOptions

__all__ = ["ErrorRuntime", "Stability", "Study"]


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
    """Number of independent sequences of masks."""
    trust: Trust = ()
    device: Device = "cpu"

    def check(self) -> None:
        for source in self.sources:
            check_model(source, OrbitOptions() if is_ply(source) else None)

    def __call__(self) -> None:
        from reference_trainer.studies.error_runtime import error_runtime_study
        from reference_trainer.studies.study import run_study

        study = error_runtime_study(
            self.sources, max_samples=self.max_samples, seeds=self.seeds, device=self.device, trust=self.trust
        )
        run_study(study, self.out)


@dataclass(frozen=True)
class Stability:
    """Extreme cases of the CPU's engines against float64 and exact arithmetic: right, refused, or limits, and where."""

    out: Path = Path("runs/stability")
    """Folder for the JSON, the tables and the picture."""

    def __call__(self) -> None:
        from reference_trainer.studies.stability.stability_study import study_stability

        study_stability(self.out)


@dataclass(frozen=True)
class Study:
    """Measure something about the method itself."""

    # tyro makes a command of every member.
    what: ErrorRuntime | Stability
