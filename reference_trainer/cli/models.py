"""Commands on trained models, of runs or as PLY files: one class per command, whose fields are its options."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reference_trainer.cli import options
from reference_trainer.cli.options import Device, Orbit, PlyScene, Rendering, RenderOptions, Trust, scene_or_orbit
from reference_trainer.cli.training import PORT, Lpips
from reference_trainer.runs.folder import check_run, folder_name, modules_named, report_file, runs_of
from reference_trainer.scenes.options import OrbitOptions, SceneOptions

__all__ = ["Bake", "Clean", "Diff", "Evaluate", "Render", "Report", "View"]

ModelScene = Annotated[PlyScene, tyro.conf.arg(name="scene")]


@dataclass(frozen=True)
class Evaluate:
    """Measure a run, or any 3DGS PLY: PSNR, SSIM, LPIPS, CA, CV.

    Per view and mean, on the views of a scene. A PLY without a scene is measured from cameras on an orbit around it:
    CA (exact, of the paper's protocol, and without the background) and CV.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`, or a standard 3DGS PLY."""
    scene: ModelScene = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    regularizer: str | None = None
    """Render as if it had been trained with these: "dropout(0.2)" for a PLY that does not say so, or "noise(0.8,
    scale=True)" for a run with noise 0.8, to render with the mean opacities."""
    samples: int = 5
    """Renders per view for the CA score."""
    seed: int = 0
    """Seed of the CA score's masks."""
    lpips: Lpips = None
    trust: Trust = ()
    device: Device = "cpu"
    out: Path | None = None
    """Folder for the results; by default <run>/evaluation or <ply>_evaluation, with _orbit or _<regularizer> behind."""
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        where = scene_or_orbit(self.run, self.scene, self.orbit)
        if isinstance(where, OrbitOptions) and self.lpips is not None:
            raise ValueError("without photographs there is no --lpips: give --scene.")
        options.check_model(self.run, where)
        options.check_out(self.out, self.run, where)

    def __call__(self) -> None:
        from reference_trainer.evaluation.lpips import load_lpips
        from reference_trainer.runs.guarded import log_what_hangs, removed_from
        from reference_trainer.runs.measure import load_run_model, measure
        from reference_trainer.runs.ply import score_ply
        from reference_trainer.scenes.virtual_cameras import measured_views

        where = scene_or_orbit(self.run, self.scene, self.orbit)
        self.rendering.begin(self.device)
        # Modules named on this command line are trusted; --trust is for those that a file names.
        trust = {*self.trust, *modules_named(self.regularizer or "")}
        shared: dict[str, Any] = {
            "samples": self.samples, "seed": self.seed, "perceptual": load_lpips(self.lpips, device=self.device)
        }  # fmt: skip
        if where is None:
            model, scene = load_run_model(self.run, self.device, regularizer=self.regularizer, trust=trust)
            # A folder of its own, or the scores of another regularizer would take the place of the run's.
            name = "evaluation" if self.regularizer is None else f"evaluation_{folder_name(self.regularizer)}"
            out = self.out or self.run / name
            measure(model, measured_views(scene), out, about={"scene": scene.name}, **shared)
            for line in removed_from(self.run):
                print(line)
            log_what_hangs(model, scene, out)
        else:
            shared |= {"regularizer": self.regularizer, "device": self.device, "background": self.scene.background}
            score_ply(self.run, where, self.out, trust=trust, **shared)


@dataclass(frozen=True)
class Render:
    """Render a run's views as PNG, or a flight also as a film.

    The film is an MP4 with ca_reg[photos], else an animated WebP.
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run of `ca-reg train`."""
    what: Literal["auto", "test", "train", "flight", "error"] = "auto"
    """Which views: "auto" is the test views, or if none was held out the training views; "flight" moves through the
    training cameras. "error" also writes where each picture is expected to be wrong: of the test views, or if none was
    held out, of views between and around the training cameras."""
    mask: float | None = None
    """With --what error: also write masks, white where the expected error is above this, such as 0.05: where to repaint
    (an absolute difference of colors in [0, 1])."""
    # None, not 60, so that `check` can refuse it where it has no effect.
    frames: int | None = None
    """With --what flight: its pictures, by default 60."""
    out: Path | None = None
    """Folder for the pictures; by default <run>/render_<what>."""
    trust: Trust = ()
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        check_run(self.run)
        options.check_out(self.out, self.run)
        if self.mask is not None and not (self.what == "error" and 0 < self.mask < 1):
            got = f"--what {self.what} --mask {self.mask:g}"
            raise ValueError(f"--mask needs --what error and a threshold in (0, 1), got {got}.")
        if self.frames is not None and self.what != "flight":
            raise ValueError(f"--frames needs --what flight, got --what {self.what}.")

    def __call__(self) -> None:
        from reference_trainer.runs.measure import render_run

        self.rendering.begin(self.device)
        frames = 60 if self.frames is None else self.frames
        render_run(self.run, self.what, self.out, frames=frames, mask=self.mask, device=self.device, trust=self.trust)


@dataclass(frozen=True)
class Report:
    """Write one HTML file about runs: scores, views, 3D models.

    The models can be turned, in their colors or in co-adaptation heat. The file needs only a browser: no server, no
    network. Several runs on one scene are shown side by side.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs of `ca-reg train` on one scene, finished or not, or that of a comparison."""
    out: Path | None = None
    """The file; by default report.html in the folder of the run, or in the deepest one common to all runs."""
    views: int = 8
    """Views of each split that are shown, evenly spaced."""
    trust: Trust = ()
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        if not self.runs:
            raise ValueError("expected at least 1 run to report on: give the --out folders of ca-reg train.")
        if self.out is not None and self.out.is_dir():
            report_file(self.runs, self.out)
        for run in self.runs:
            if not runs_of(run):
                check_run(run)
        report_file(self.runs, self.out)

    def __call__(self) -> None:
        from reference_trainer.report.page import write_report

        self.rendering.begin(self.device)
        write_report(self.runs, self.out, views=self.views, device=self.device, trust=self.trust)


@dataclass(frozen=True)
class Diff:
    """Compare two trainings, score by score, in the terminal.

    With differences, the settings that differ, and whether the seeds tell the two apart, for which each needs three.
    """

    first: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or one with seed_0, seed_1 and so on, such as <out>/baseline of `ca-reg compare`."""
    second: Annotated[Path, tyro.conf.Positional]
    """The other one, trained on the same scene."""

    def __call__(self) -> None:
        from reference_trainer.evaluation.tables import markdown_table, print_table
        from reference_trainer.report.page import compare_two

        rows, notes = compare_two(self.first, self.second)
        print_table(markdown_table(rows, list(rows[0])))
        print("\n".join(notes))


@dataclass(frozen=True)
class View:
    """Explore a run, or any 3DGS PLY, live in a browser.

    Two are shown side by side, with one camera. Shows render, co-adaptation, depth or heat, as this package renders
    them. Needs ca_reg[viewer]; Ctrl-C ends it.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folder of a run of `ca-reg train`, finished or not, or a standard 3DGS PLY; of two, one stands beside the other,
    seen from the cameras of the first."""
    scene: ModelScene = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    regularizer: str | None = None
    """Show it as if it had been trained with these, such as "dropout(0.2)"."""
    port: int = PORT
    """Port of the page on this machine; 0 for any free one."""
    trust: Trust = ()
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        if not 1 <= len(self.runs) <= 2 or len(set(self.runs)) < len(self.runs):
            raise ValueError(f"expected 1 model to show, or 2 that differ, got {[str(run) for run in self.runs]}.")
        for run in self.runs:
            options.check_model(run, scene_or_orbit(run, self.scene, self.orbit))

    def __call__(self) -> None:
        from reference_trainer.runs.measure import load_run_model
        from reference_trainer.runs.ply import ModelWithViews, load_for_views
        from reference_trainer.scenes.virtual_cameras import measured_views
        from reference_trainer.viewer.window import Viewer

        trust = {*self.trust, *modules_named(self.regularizer or "")}
        shared: dict[str, Any] = {"regularizer": self.regularizer, "device": self.device, "trust": trust}
        # First of all: a port in use, or a missing viser, is refused before anything is compiled or loaded.
        with Viewer(self.port) as viewer:
            self.rendering.begin(self.device, trains=True)  # so that no later picture waits for the compiler
            first: ModelWithViews | None = None
            for run in self.runs:
                where = scene_or_orbit(run, self.scene, self.orbit)
                if where is None:
                    model, scene = load_run_model(run, **shared)
                    loaded = ModelWithViews(model, 1.0, measured_views(scene), scene, {})
                else:
                    loaded = load_for_views(run, where, background=self.scene.background, **shared)
                first = first or loaded
                shown = loaded.beside(first)
                viewer.show(shown.model, shown.views, str(run))
            print(f"{viewer}; Ctrl-C ends it.", flush=True)
            viewer.serve()


@dataclass(frozen=True)
class Bake:
    """Give a PLY its test-time opacities, for other viewers.

    Other viewers do not know that after dropout p, for example, opacities are to be scaled by 1 - p. A comment in the
    file records that it was done.
    """

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY of a model that was trained with regularizers, opacities plain."""
    regularizer: str | None = None
    """What it was trained with, such as "dropout(0.2)"; PLYs of `ca-reg train` say so themselves."""
    out: Path | None = None
    """The file to write; by default <ply>_for_viewers.ply. An .spz, a tenth of the size, or an .sog is for viewers in
    the web, and needs ca_reg[web]."""
    trust: Trust = ()

    def check(self) -> None:
        options.check_ply(self.ply)
        options.check_model(self.ply, OrbitOptions())

    def __call__(self) -> None:
        from reference_trainer.runs.edit_ply import SMALL, bake_ply, compress_ply

        out = self.out or self.ply.with_name(f"{self.ply.stem}_for_viewers.ply")
        if out.suffix.lower() in SMALL:
            compress_ply(self.ply, out, regularizer=self.regularizer, trust=self.trust)
            print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, opacities those of the test")
            return
        regularizer = bake_ply(self.ply, out, regularizer=self.regularizer, trust=self.trust)
        print(f"{out}: opacities are those of the test after {regularizer}, and marked so")


@dataclass(frozen=True)
class Clean:
    """Remove the Gaussians of a PLY that co-adapt most; refine.

    Removes those with the most co-adaptation per contribution, and prints a table of before and after. A few training
    steps on the photographs of the scene close the holes; without a scene, on an orbit, they stay. For models that were
    trained without a regularizer: after dropout there is little to remove, and without --anyway such a model is
    refused. Those can be freed of what hangs before and beside the cameras (--hanging), without a photograph.
    """

    ply: Annotated[Path, tyro.conf.Positional]
    """A standard 3DGS PLY, opacities plain."""
    scene: ModelScene = field(default_factory=PlyScene)
    orbit: Orbit = field(default_factory=OrbitOptions)
    # None, not 0.1, so that `check` can refuse it where it has no effect.
    fraction: float | None = None
    """Fraction of the Gaussians to remove, by default 0.1."""
    hanging: bool = False
    """Remove instead what hangs where nobody took a photograph; for models trained with dropout or noise."""
    refine: int | None = None
    """Training steps afterwards; by default 100, with --hanging none."""
    regularizer: str | None = None
    """What it was trained with, such as "dropout(0.2)"; PLYs of `ca-reg train` say so themselves."""
    anyway: bool = False
    """Clean a model that was trained with dropout, too."""
    out: Path | None = None
    """The file to write; by default <ply>_clean.ply."""
    trust: Trust = ()
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    def check(self) -> None:
        options.check_ply(self.ply)
        if self.hanging and self.fraction is not None:
            raise ValueError(f"--hanging removes all that hangs: leave out --fraction {self.fraction:g}, or --hanging.")
        where = scene_or_orbit(self.ply, self.scene, self.orbit)
        if self.refine and isinstance(where, OrbitOptions):
            raise ValueError(f"--refine {self.refine} needs photographs: give --scene FOLDER.")
        options.check_model(self.ply, where)

    def __call__(self) -> None:
        from reference_trainer.runs.edit_ply import clean_ply

        where = scene_or_orbit(self.ply, self.scene, self.orbit)
        assert where is not None
        # Refining needs photographs. With an orbit nothing is trained, so the loops of a training are not compiled.
        self.rendering.begin(self.device, trains=isinstance(where, SceneOptions))
        clean_ply(
            self.ply,
            where,
            self.out or self.ply.with_name(f"{self.ply.stem}_clean.ply"),
            fraction=0.1 if self.fraction is None else self.fraction,
            refine=self.refine,
            hanging=self.hanging,
            background=self.scene.background,
            regularizer=self.regularizer,
            anyway=self.anyway,
            device=self.device,
            trust=self.trust,
        )
