"""Commands that train, and the plan of a training: one class per command, whose fields are its options."""

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

from reference_trainer.cli.options import Device, Rendering, RenderOptions
from reference_trainer.runs.executors import ExecutorName
from reference_trainer.runs.folder import PLAN, check_output, is_own_plan, modules_named
from reference_trainer.scenes.options import SceneOptions, check_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import RECIPES

__all__ = ["PORT", "Compare", "Demo", "Lpips", "Plan", "Train", "given_fields"]

PORT = 8080
"""Default port of the viewer."""
PICTURES_FROM = 400
"""Smallest interval of measurements, in steps, at which pictures cost less than 3 % of a training: those of one
measurement take the time of about eleven (docs/view.md)."""

Scene = Annotated[SceneOptions, tyro.conf.arg(name="scene")]
Folder = Annotated[
    str | None,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="[SCENE]", help='Scene folder, or "synthetic"; the same as --path.'),
]
Config = Annotated[TrainConfig, tyro.conf.arg(name="")]  # whose groups have names
Recipe = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="{" + ",".join(RECIPES) + "}",
        help="Settings of a published method, whose steps scale with --iterations; other options override it, and "
        "`ca-reg recipes` says more. By default 3dgs, at 3,000 steps.",
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

    From three views; needs no files and takes minutes. Gives a table of test quality and co-adaptation, and a page
    with the models, the pictures and a plot of the dynamics.
    """

    out: Path = Path("runs/demo")
    """Folder for everything that is written; an interrupted demo continues."""
    iterations: int = 1000
    """Training steps of each run."""
    seeds: int = 1
    """Number of seeds."""
    jobs: int = 2
    """Runs at a time."""
    rendering: Rendering = field(default_factory=RenderOptions)

    def __call__(self) -> None:
        steps = self.iterations
        comparison = Compare(
            self.out,
            config=TrainConfig(iterations=steps, opacity_reset_every=0, densify_from=min(500, steps // 4)),
            seeds=self.seeds,
            jobs=self.jobs,
            executor="processes",  # of this machine, even where $RAY_ADDRESS names a cluster
            monitor_every=max(1, steps // 5),
            rendering=self.rendering,
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
    rendering: Rendering = field(default_factory=RenderOptions)
    monitor_every: int = 500
    """Steps between measurements of CA and PSNR for TensorBoard; 0 for none."""
    monitor_pictures: Literal["auto", "on", "off"] = "auto"
    """Show TensorBoard render, error, exact CA map and shares of the first view of each split as well; "auto": where
    that costs less than 3 % of the time, with at least 400 steps between measurements."""
    log_to: tuple[Literal["wandb", "mlflow"], ...] = ()
    """Where curves and pictures go besides TensorBoard, as these are set up on this machine."""
    lpips: Lpips = None
    viewer: Annotated[tuple[()] | tuple[int] | None, tyro.conf.arg(metavar="[PORT]")] = None
    """Show the model in a browser while it trains, by default at port 8080; needs ca_reg[viewer]."""
    deterministic: bool = False
    """One thread and repeatable algorithms: the same result whatever the number of threads, and on CUDA every time."""

    def check(self) -> None:
        scene = _chosen(self.scene, self.folder)
        check_scene(scene.path)
        check_output(self.out, scene.path, ())
        if self.deterministic and self.config.renderer == "gsplat":
            raise ValueError(
                "--deterministic needs this package's own renderer: gsplat's kernels add gradients in whatever order "
                "they come, which PyTorch cannot change."
            )

    def __call__(self) -> None:
        from reference_trainer.evaluation.tables import print_table, summary
        from reference_trainer.runs.run import Monitoring, run_experiment
        from reference_trainer.training.randomness import deterministic

        # A training that is shorter than the interval is measured once, at its end.
        between = min(self.monitor_every, self.config.iterations)
        pictures = between >= PICTURES_FROM if self.monitor_pictures == "auto" else self.monitor_pictures == "on"
        monitoring = Monitoring(self.monitor_every, pictures=pictures, sinks=self.log_to)
        with ExitStack() as stack:
            hooks: dict[str, Any] = {}
            if self.viewer is not None:
                from reference_trainer.viewer.window import Viewer

                viewer = stack.enter_context(Viewer(*self.viewer or (PORT,)))
                hooks = {"on_step": viewer.follow}
                print(viewer)
            if self.config.renderer == "builtin":
                self.rendering.begin(self.device, trains=True)
            if self.deterministic:
                stack.enter_context(deterministic(self.device))
            results = run_experiment(
                _chosen(self.scene, self.folder),
                self.config,
                self.out,
                auto=self.auto,
                given=self.given,
                device=self.device,
                monitoring=monitoring,
                lpips=self.lpips,
                progress=True,
                **hooks,
            )
        print_table(summary(results))
        out, trust = shlex.quote(str(self.out)), _trust(self.config, self.scene)
        print(f"Everything is in {self.out}; a page: ca-reg report {out}{trust}; curves: tensorboard --logdir {out}")


def _trust(*settings: object) -> str:
    """Return what a command on a run of these settings has to add, if they name modules of the user's."""
    modules = sorted(set[str]().union(*map(modules_named, settings)))
    return f" --trust {shlex.join(modules)}" if modules else ""


@dataclass(frozen=True)
class Plan:
    """Say what training will use of a scene, and why.

    Also says what it leaves out, and which setting is recommended; trains nothing.
    """

    folder: Folder = None
    scene: Scene = field(default_factory=SceneOptions)
    config: Config = field(default_factory=TrainConfig)
    recipe: Recipe = None
    given: Given = frozenset()
    verbose: bool = False
    """List all decisions with their reasons."""
    out: Path | None = None
    """JSON file for the plan; by default none is written."""

    def check(self) -> None:
        check_scene(_chosen(self.scene, self.folder).path)
        # An earlier plan, known by its entry for the items, may be overwritten, and no other file.
        if self.out is not None and self.out.is_dir():
            raise ValueError(f"{self.out} is a folder: --out is the file to write, such as {self.out / PLAN}.")
        if self.out is not None and self.out.exists() and not is_own_plan(self.out):
            raise ValueError(f"{self.out} is no plan of ca-reg and is not overwritten: give another --out.")

    def __call__(self) -> None:
        from reference_trainer.evaluation.results import write_json
        from reference_trainer.evaluation.tables import markdown_table, print_table
        from reference_trainer.scenes import load_scene
        from reference_trainer.training.plan import make_plan

        options = _chosen(self.scene, self.folder)
        scene = load_scene(options, seed=self.config.seed)
        plan = make_plan(scene, self.config, given=self.given)
        print(scene)
        first, *others = plan.summary().splitlines()
        print("\n".join([first if self.verbose else f"{first} All {len(plan.items)} decisions: --verbose", *others]))
        if self.verbose:
            print_table(f"\n{markdown_table(plan.rows(), ['item', 'decision', 'change', 'reason'])}")
        if self.out is not None:
            write_json(self.out, plan.as_dict())
            print(f"The plan is in {self.out}.")


@dataclass(frozen=True)
class EveryScene(SceneOptions):
    """The scene options shared by all scenes of a comparison."""

    path: Annotated[str, tyro.conf.Suppress] = "synthetic"  # each scene has its own


@dataclass(frozen=True)
class Compare:
    """Train baseline, dropout, noise and both, with several seeds.

    One table per scene with mean and spread. Finished runs are kept: the same command continues an interrupted
    comparison, or adds strategies or seeds. A run that fails, or a page, is reported at the end and does not stop the
    others; the exit code is then 1.
    """

    out: Path
    """Folder of the comparison; each run has a folder <strategy>/seed_<k> in it, below <scene> if there are several."""
    folders: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Scene folders, or "synthetic"; the same as --path."""
    path: tuple[str, ...] = ()
    """Scene folders, by default "synthetic"; the other options hold for all of them."""
    scene: Annotated[EveryScene, tyro.conf.arg(name="scene")] = field(default_factory=EveryScene)
    config: Config = field(default_factory=TrainConfig)
    recipe: Recipe = None
    strategies: tuple[str, ...] = ("baseline", "dropout", "noise", "both")
    """What to compare: these, "analytic-dropout", "analytic-noise", whose rates --dropout and --noise give (0.2 and 0.8
    if they are 0), or regularizers as of --regularizer, such as "d2gs"."""
    seeds: int = 3
    """Number of seeds, the first being --seed."""
    jobs: int = 1
    """Runs at a time, each in its own process with its share of the processors (of the whole cluster, on Ray)."""
    executor: ExecutorName = "auto"
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
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        if self.folders and self.path:
            raise ValueError(
                f"give the scenes as arguments or as --path, not both: got {self.folders} and {self.path}."
            )
        for path in self._paths:
            check_scene(path)

    @property
    def _paths(self) -> tuple[str, ...]:
        return self.folders or self.path or ("synthetic",)

    @property
    def elsewhere(self) -> bool:
        """Whether runs may execute on other machines, whose devices are unknown here."""
        return self.executor != "processes" and bool(self.address or os.environ.get("RAY_ADDRESS"))

    def __call__(self) -> None:
        from reference_trainer.report.page import write_report
        from reference_trainer.runs.compare import compare, report, scene_folders, strategies
        from reference_trainer.runs.executors import choose_executor
        from reference_trainer.runs.grid import Running
        from reference_trainer.runs.run import Monitoring

        chosen = strategies(
            self.strategies, self.config, dropout=self.config.dropout or 0.2, noise=self.config.noise or 0.8
        )
        running = Running(
            choose_executor(self.executor, jobs=self.jobs, address=self.address, device=self.device),
            retries=self.retries,
            device=self.device,
            monitoring=Monitoring(self.monitor_every, checkpoint_every=self.checkpoint_every),
            lpips=self.lpips,
        )
        if self.config.renderer == "builtin":
            self.rendering.begin(self.device, trains=True)
        scenes, seeds = scene_folders(self._paths, self.scene, self.out), range(self.seeds)
        comparisons = compare(scenes, chosen, [self.config.seed + number for number in seeds], running)
        report(comparisons)
        trust = set[str]().union(*map(modules_named, (self.scene, *chosen.values())))  # named on this command line
        # The pages are written here, where the machines of a cluster may have cards and this one none.
        here = self.device if not self.elsewhere else "cpu"
        failed = any(comparison.failures for comparison in comparisons.values())
        # Where every run failed there is nothing to show.
        for folder in [folder for folder, comparison in comparisons.items() if comparison.runs]:
            try:
                write_report([folder], device=here, trust=trust)
            except ValueError as error:  # of a run from before, of another scene or with code not named here
                print(f"ca-reg: no page, for which there is ca-reg report {folder}: {error}", file=sys.stderr)
                failed = True
        if failed:
            sys.exit(1)
