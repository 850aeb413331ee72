"""Commands about runs: train, evaluate, render, compare. One class per command, its fields are the options."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import PRESETS, TrainConfig

__all__ = ["Compare", "Demo", "Evaluate", "Render", "Train"]

Scene = Annotated[SceneOptions, tyro.conf.arg(name="")]
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]
Strategy = Literal["baseline", "dropout", "noise", "both", "analytic-dropout", "analytic-noise"]


@dataclass(frozen=True)
class Demo:
    """Train the built-in scene from three views with and without the regularizers; needs no files, takes minutes.

    Ends with a table of test quality and co-adaptation, a plot of the dynamics, and pictures.
    """

    out: Path = Path("runs/demo")
    """Folder for everything that is written; an interrupted demo continues."""
    iterations: int = 1000
    """Training steps of each run."""
    seeds: int = 1
    """Number of seeds."""
    jobs: int = 2
    """Runs at a time."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.studies.demo import demo

        demo(self.out, iterations=self.iterations, seeds=range(self.seeds), jobs=self.jobs, say=print)


@dataclass(frozen=True)
class Train:
    """Train one model on a scene and evaluate it.

    Writes a checkpoint, a standard 3DGS PLY, CA dynamics (JSONL and TensorBoard), pictures of every view, and scores.
    The same command continues an interrupted run.
    """

    out: Path
    """Folder of the run."""
    scene: Scene = field(default_factory=SceneOptions)
    config: Config = field(default_factory=lambda: PRESETS["fsgs"])
    preset: Literal["fsgs", "inria", "binocular"] = "fsgs"
    """Schedule of a published code base; other options override it."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    monitor_every: int = 500
    """Steps between measurements of CA and PSNR for TensorBoard; 0 for none."""
    lpips: str | None = None
    """Perceptual metric: "installed" to use what is installed, or a weights file; by default none."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.studies.run import run_experiment, summary

        results = run_experiment(
            self.scene,
            self.config,
            self.out,
            device=self.device,
            monitor_every=self.monitor_every,
            lpips=self.lpips,
            progress=True,
            say=print,
        )
        print(summary(results))
        print(f"Everything is in {self.out}; curves: tensorboard --logdir {self.out}")


@dataclass(frozen=True)
class Evaluate:
    """Measure a run, or any 3DGS PLY, on the views of a scene: PSNR, SSIM, LPIPS, CA, CV, per view and mean."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of a run of `ca-reg train`."""
    ply: Path | None = None
    """A standard 3DGS PLY instead of a run; give its scene with --path."""
    scene: Scene = field(default_factory=SceneOptions)
    dropout: float = 0.0
    """For a PLY: the dropout rate that it was trained with."""
    scale_noise: bool = False
    """For a run with noise: scale opacities by its mean, even if the run was trained without --scale-noise."""
    samples: int = 5
    """Renders per view for the CA score."""
    seed: int = 0
    """Seed of the CA score's masks."""
    lpips: str | None = None
    """Perceptual metric: "installed" to use what is installed, or a weights file; by default none."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    out: Path | None = None
    """Folder for evaluation.json and pictures; by default <run>/evaluation, or <run>/evaluation_scale_noise."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.evaluation.lpips import lpips_option
        from reference_trainer.studies.measure import measure, of_ply, of_run

        if self.run is not None:
            model, scene, default = of_run(self.run, self.device, scale_noise=self.scale_noise)
        elif self.ply is not None:
            if self.scale_noise:
                raise ValueError(
                    "--scale-noise needs the folder of a run: a PLY does not say which noise it was trained with."
                )
            model, scene, default = of_ply(self.ply, self.scene, dropout=self.dropout, device=self.device)
        else:
            raise ValueError("nothing to evaluate: give the folder of a run, or --ply FILE and --path SCENE.")
        perceptual = lpips_option(self.lpips, device=self.device)
        measure(model, scene, self.out or default, samples=self.samples, seed=self.seed, perceptual=perceptual)


@dataclass(frozen=True)
class Render:
    """Render a run's views, or a flight between its training cameras, as PNG (and GIF)."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`."""
    what: Literal["test", "train", "flight"] = "test"
    """Which views; "flight" moves through the training cameras."""
    frames: int = 60
    """Pictures of a flight."""
    out: Path | None = None
    """Folder for the pictures; by default <run>/render_<what>."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.studies.measure import render_run

        render_run(self.run, self.what, self.out, frames=self.frames, device=self.device, say=print)


@dataclass(frozen=True)
class Compare:
    """Train baseline, dropout, noise and both on a scene with several seeds; one table with mean and spread.

    Finished runs are kept: the same command continues an interrupted comparison, or adds seeds.
    """

    out: Path
    """Folder of the comparison; each run has a folder <strategy>/seed_<k> in it."""
    scene: Scene = field(default_factory=SceneOptions)
    config: Config = field(default_factory=lambda: PRESETS["fsgs"])
    preset: Literal["fsgs", "inria", "binocular"] = "fsgs"
    """Schedule of a published code base; other options override it."""
    strategies: tuple[Strategy, ...] = ("baseline", "dropout", "noise", "both")
    """What to compare; --dropout and --noise give the rates (0.2 and 0.8 if they are 0)."""
    seeds: int = 3
    """Number of seeds."""
    jobs: int = 1
    """Runs at a time, each in its own process with its share of the processors."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    monitor_every: int = 500
    """Steps between measurements of CA and PSNR; 0 for none."""
    lpips: str | None = None
    """Perceptual metric: "installed" to use what is installed, or a weights file; by default none."""

    def __call__(self) -> None:
        """Run the command."""
        from reference_trainer.studies.compare import compare, report, strategies

        config = replace(self.config, dropout=0.0, noise=0.0, analytic=False, ca_weight=0.0, scale_noise=False)
        every = strategies(
            config,
            dropout=self.config.dropout or 0.2,
            noise=self.config.noise or 0.8,
            scale_noise=self.config.scale_noise,
        )
        chosen: dict[str, TrainConfig] = {name: every[name] for name in self.strategies}
        comparison = compare(
            self.scene,
            chosen,
            range(self.seeds),
            self.out,
            jobs=self.jobs,
            device=self.device,
            monitor_every=self.monitor_every,
            lpips=self.lpips,
            say=print,
        )
        report(comparison, self.out, say=print)
