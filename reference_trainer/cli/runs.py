"""Commands on runs: plan, train, evaluate, render, compare. One class per command, whose fields are its options."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reference_trainer.cli.drawing import Device, Draw, Drawing
from reference_trainer.cli.places import Orbit, PlyScene, place_of
from reference_trainer.runs.engines.choice import EngineName
from reference_trainer.scenes.options import OrbitOptions, SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES

__all__ = ["PORT", "Compare", "Demo", "Evaluate", "Plan", "Render", "Train", "given_fields"]

PORT = 8080
"""Default port of the viewer."""
PICTURES_FROM = 400
"""Smallest interval of measurements, in steps, at which pictures cost less than 2 % of a training: those of one
measurement take the time of 7 steps (fern at 252x189, 40,110 Gaussians)."""

Scene = Annotated[SceneOptions, tyro.conf.arg(name="")]
Folder = Annotated[
    str | None, tyro.conf.Positional, tyro.conf.arg(help='Scene folder, or "synthetic"; the same as --path.')
]
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]
Recipe = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="{" + ",".join(RECIPES) + "}",
        help="Settings of a published method, whose steps scale with --iterations; other options override it, and "
        "`ca-reg recipes` says more. By default the settings as they are listed here, at which nothing scales.",
    ),
]
Lpips = Annotated[
    str | None,
    tyro.conf.arg(help='Perceptual metric: "installed" to use what is installed, or a weights file; by default none.'),
]
Given = Annotated[frozenset[str], tyro.conf.Suppress]  # filled in from the command line itself, see given_fields


def given_fields(arguments: Sequence[str]) -> frozenset[str]:
    """Return the fields of `TrainConfig` that a command line sets, even if to their default.

    Example:
        >>> sorted(given_fields(["train", "--sh-degree", "3", "--densify_every=100", "--no-analytic"]))
        ['analytic', 'densify_every', 'sh_degree']
    """
    words = {word.partition("=")[0].removeprefix("--").replace("-", "_") for word in arguments if word[:2] == "--"}
    return frozenset(f.name for f in fields(TrainConfig) if words & {f.name, f"no_{f.name}"})


def _chosen(scene: SceneOptions, folder: str | None) -> SceneOptions:
    """Return the options of a scene with its folder, which may be given as the first argument or as --path."""
    if folder is not None and scene.path not in (SceneOptions().path, folder):
        raise ValueError(f"give the scene as the first argument or as --path, not both: got {folder} and {scene.path}.")
    return scene if folder is None else replace(scene, path=folder)


@dataclass(frozen=True)
class Demo:
    """Train the built-in scene with and without the regularizers.

    From three views; needs no files and takes minutes. Gives a table of test quality and co-adaptation, a plot of the
    dynamics, and pictures.
    """

    out: Path = Path("runs/demo")
    """Folder for everything that is written; an interrupted demo continues."""
    iterations: int = 1000
    """Training steps of each run."""
    seeds: int = 1
    """Number of seeds."""
    jobs: int = 2
    """Runs at a time."""
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        steps = self.iterations
        comparison = Compare(
            self.out,
            config=TrainConfig(iterations=steps, opacity_reset_every=0, densify_from=min(500, steps // 4)),
            seeds=self.seeds,
            jobs=self.jobs,
            executor="processes",
            monitor_every=max(1, steps // 5),
            drawing=self.drawing,
        )
        what = f"the built-in scene (3 views) with {', '.join(comparison.strategies)}"
        print(f"Training {what}: {steps} steps each, {self.jobs} at a time.")
        comparison()


@dataclass(frozen=True)
class Train:
    """Train one model on a scene and evaluate it.

    Writes a checkpoint, a standard 3DGS PLY, CA dynamics (JSONL and TensorBoard), pictures of every view, and scores.
    The same command continues an interrupted run.
    """

    folder: Folder = None
    out: Path = Path("runs/train")
    """Folder of the run."""
    scene: Scene = field(default_factory=SceneOptions)
    config: Config = field(default_factory=TrainConfig)
    recipe: Recipe = None
    auto: bool = True
    """Leave out what the scene does not need, as `ca-reg plan` says; what other options or the recipe set stays."""
    given: Given = frozenset()
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)
    monitor_every: int = 500
    """Steps between measurements of CA and PSNR for TensorBoard; 0 for none."""
    monitor_pictures: Literal["auto", "on", "off"] = "auto"
    """Show TensorBoard render, error, exact CA map and shares of the first view of each split as well; "auto": where
    that costs less than 2 % of the time, with at least 400 steps between measurements."""
    lpips: Lpips = None
    viewer: Annotated[tuple[()] | tuple[int] | None, tyro.conf.arg(metavar="[PORT]")] = None
    """Show the model in a browser while it trains, by default at port 8080; needs ca_reg[viewer]."""
    deterministic: bool = False
    """One thread and repeatable algorithms: the same result whatever the number of threads, and on CUDA every time."""

    def __call__(self) -> None:
        from reference_trainer.evaluation.tables import summary
        from reference_trainer.runs.run import run_experiment
        from reference_trainer.training.randomness import deterministic

        if self.deterministic and self.config.renderer == "gsplat":
            raise ValueError(
                "--deterministic needs --renderer builtin: gsplat's kernels add gradients in whatever order they come, "
                "which PyTorch cannot change."
            )
        between = min(self.monitor_every, self.config.iterations)
        pictures = between >= PICTURES_FROM if self.monitor_pictures == "auto" else self.monitor_pictures == "on"
        with ExitStack() as stack:
            watched: dict[str, Any] = {}
            if self.viewer is not None:
                from reference_trainer.viewer.window import Viewer

                viewer = stack.enter_context(Viewer(*self.viewer or (PORT,)))
                watched = {"watch": viewer.follow}
                print(viewer)
            if self.config.renderer == "builtin":
                self.drawing.begin(self.device, trains=True)
            if self.deterministic:
                stack.enter_context(deterministic(self.device))
            results = run_experiment(
                _chosen(self.scene, self.folder),
                self.config,
                self.out,
                auto=self.auto,
                given=self.given,
                device=self.device,
                monitor_every=self.monitor_every,
                monitor_pictures=pictures,
                lpips=self.lpips,
                progress=True,
                say=print,
                **watched,
            )
        print(summary(results))
        out = shlex.quote(str(self.out))
        print(f"Everything is in {self.out}; a page: ca-reg report {out}; curves: tensorboard --logdir {out}")


@dataclass(frozen=True)
class Plan:
    """Say what training will use of a scene, and why.

    Also says what it leaves out; trains nothing.
    """

    folder: Folder = None
    scene: Scene = field(default_factory=SceneOptions)
    config: Config = field(default_factory=TrainConfig)
    recipe: Recipe = None
    given: Given = frozenset()
    out: Path | None = None
    """JSON file for the plan; by default none is written."""

    def __call__(self) -> None:
        from reference_trainer.evaluation.results import markdown_table, write_json
        from reference_trainer.scenes import load_scene
        from reference_trainer.training.plan import make_plan

        scene = load_scene(_chosen(self.scene, self.folder), seed=self.config.seed)
        plan = make_plan(scene, self.config, given=self.given)
        print(f"{scene}\n")
        print(markdown_table(plan.rows(), ["item", "decision", "change", "reason"]))
        if self.out is not None:
            write_json(self.out, plan.as_dict())
            print(f"The plan is in {self.out}.")


@dataclass(frozen=True)
class Evaluate:
    """Measure a run, or any 3DGS PLY: PSNR, SSIM, LPIPS, CA, CV.

    Per view and mean, on the views of a scene. A PLY without a scene is measured from cameras on an orbit around it: CA
    (protocol, exact, and exact without the background) and CV.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`, or a standard 3DGS PLY."""
    scene: Annotated[PlyScene, tyro.conf.arg(name="")] = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    regularizer: str | None = None
    """Render as if it had been trained with these: "dropout(0.2)" for a PLY that does not say so, or "noise(0.8,
    scale=True)" for a run with noise 0.8, to render with the mean opacities."""
    samples: int = 5
    """Renders per view for the CA score."""
    seed: int = 0
    """Seed of the CA score's masks."""
    lpips: Lpips = None
    device: Device = "cpu"
    out: Path | None = None
    """Folder for the results; by default <run>/evaluation, <run>/evaluation_<regularizer> or <ply>_evaluation."""
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.evaluation.lpips import load_lpips
        from reference_trainer.evaluation.trajectory import measured_views
        from reference_trainer.runs.folder import folder_name
        from reference_trainer.runs.measure import measure, of_run
        from reference_trainer.runs.score_ply import score_ply

        place = place_of(self.run, self.scene, self.orbit)
        if isinstance(place, OrbitOptions) and self.lpips is not None:
            raise ValueError("without photographs there is no --lpips: give --path.")
        self.drawing.begin(self.device)
        shared: dict[str, Any] = {
            "samples": self.samples, "seed": self.seed, "perceptual": load_lpips(self.lpips, device=self.device)
        }  # fmt: skip
        if place is None:
            model, scene = of_run(self.run, self.device, regularizer=self.regularizer)
            name = "evaluation" if self.regularizer is None else f"evaluation_{folder_name(self.regularizer)}"
            views, out = measured_views(scene, print), self.out or self.run / name
            measure(model, views, out, about={"scene": scene.name}, **shared)
        else:
            shared |= {"regularizer": self.regularizer, "device": self.device, "background": self.scene.background}
            score_ply(self.run, place, self.out, **shared)


@dataclass(frozen=True)
class Render:
    """Render a run's views as PNG, or a flight also as GIF."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`."""
    what: Literal["test", "train", "flight"] = "test"
    """Which views; "flight" moves through the training cameras."""
    frames: int = 60
    """Pictures of a flight."""
    out: Path | None = None
    """Folder for the pictures; by default <run>/render_<what>."""
    device: Device = "cpu"
    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.runs.measure import render_run

        self.drawing.begin(self.device)
        render_run(self.run, self.what, self.out, frames=self.frames, device=self.device, say=print)


@dataclass(frozen=True)
class EveryScene(SceneOptions):
    """The scene options shared by all scenes of a comparison."""

    path: Annotated[str, tyro.conf.Suppress] = "synthetic"  # each scene has its own


@dataclass(frozen=True)
class Compare:
    """Train baseline, dropout, noise and both, with several seeds.

    One table per scene with mean and spread. Finished runs are kept: the same command continues an interrupted
    comparison, or adds seeds. A run that fails is reported at the end and does not stop the others; the exit code is
    then 1.
    """

    out: Path
    """Folder of the comparison; each run has a folder <strategy>/seed_<k> in it, below <scene> if there are several."""
    folders: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Scene folders, or "synthetic"; the same as --path."""
    path: tuple[str, ...] = ()
    """Scene folders, by default "synthetic"; the other options hold for all of them."""
    scene: Annotated[EveryScene, tyro.conf.arg(name="")] = field(default_factory=EveryScene)
    config: Config = field(default_factory=TrainConfig)
    recipe: Recipe = None
    strategies: tuple[str, ...] = ("baseline", "dropout", "noise", "both")
    """What to compare: these, "analytic-dropout", "analytic-noise", whose rates --dropout and --noise give (0.2 and 0.8
    if they are 0), or regularizers as of --regularizer, such as "d2gs"."""
    seeds: int = 3
    """Number of seeds."""
    jobs: int = 1
    """Runs at a time, each in its own process with its share of the processors (of the whole cluster, on Ray)."""
    executor: EngineName = "auto"
    """What executes runs: "processes" of this machine, or "ray" (needs ca_reg[ray]); "auto" is Ray if there is an
    address."""
    address: str | None = None
    """A running Ray cluster, "host:6379" or "auto", instead of one on this machine; by default $RAY_ADDRESS. --out
    and the scenes must be on a file system that its machines share."""
    retries: int = 3
    """How many dead workers of one run are replaced; each continues from the last checkpoint."""
    device: Device = "cpu"
    monitor_every: int = 500
    """Steps between measurements of CA and PSNR; 0 for none."""
    checkpoint_every: int = 500
    """Steps between checkpoints: what a dead worker costs at most."""
    lpips: Lpips = None
    drawing: Draw = field(default_factory=Drawing)

    @property
    def elsewhere(self) -> bool:
        """Whether runs may execute on other machines, whose devices are unknown here."""
        return self.executor != "processes" and bool(self.address or os.environ.get("RAY_ADDRESS"))

    def __call__(self) -> None:
        from reference_trainer.runs.compare import compare, scene_folders, strategies
        from reference_trainer.runs.compare_report import report
        from reference_trainer.runs.engines.choice import choose_engine
        from reference_trainer.runs.grid import Running

        chosen = strategies(
            self.strategies, self.config, dropout=self.config.dropout or 0.2, noise=self.config.noise or 0.8
        )
        if self.folders and self.path:
            raise ValueError(
                f"give the scenes as arguments or as --path, not both: got {self.folders} and {self.path}."
            )
        paths = self.folders or self.path or ("synthetic",)
        running = Running(
            choose_engine(self.executor, jobs=self.jobs, address=self.address, device=self.device),
            retries=self.retries,
            device=self.device,
            monitor_every=self.monitor_every,
            checkpoint_every=self.checkpoint_every,
            lpips=self.lpips,
            say=print,
        )
        if self.config.renderer == "builtin":
            self.drawing.begin(self.device, trains=True)
        comparisons = compare(scene_folders(paths, self.scene, self.out), chosen, range(self.seeds), running)
        report(comparisons, say=print)
        if any(comparison.failures for comparison in comparisons.values()):
            sys.exit(1)
