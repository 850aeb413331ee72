"""`ca-reg run`: from photographs to a model and its page, in steps that each resume."""

from __future__ import annotations

import math
import os
import shlex
import shutil
import sys
import webbrowser
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reference_trainer.cli.options import Device, Rendering, RenderOptions
from reference_trainer.json_files import read_json
from reference_trainer.runs import folder as run
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import with_recipe

__all__ = ["Run"]

RECIPE = "sparse"
"""The best setting known for few photographs."""
PRESETS = {"quick": (1_000, 100_000), "default": (2_000, 200_000), "quality": (5_000, 500_000)}
"""Training steps, and pixels to which photographs are reduced."""
MARK = "photographs.json"
Step = Literal["photographs", "poses", "train", "evaluate", "report"]
_WRITTEN: dict[Step, tuple[str, ...]] = {
    "photographs": (MARK, run.SCENE),
    "poses": (f"{run.SCENE}/*/sparse",),
    "train": (run.CHECKPOINT, run.CONFIG, run.PLAN, run.PLY, run.BAKED_PLY, "ca.jsonl", "events.out.*"),
    "evaluate": (run.RESULTS, "evaluation.partial.json", run.VIEWS),
    "report": ("report.html",),
}
"""What each step writes. `--from` deletes that of a step and of those after it."""

_TRAINING, _SHOWN, _MATCHED, _REFERENCE = 2.0, 30.0, 115.0, 2.9e-7
"""Of `_forecast`: a training step, measuring and showing a view, and a photograph of the dense start if it is matched
at the size of the training, all in timed steps; seconds of such a step per pixel on the machine on which the seconds of
the poses were measured."""


@dataclass(frozen=True)
class Run:
    """Make a model, and a page about it, from photographs.

    Finds the cameras, trains at the setting that is best known for few photographs, measures, and writes the page; says
    first how long it will take. The same command goes on where it stopped. Needs ca_reg[colmap] where there are no
    cameras, ca_reg[photos] for HEIC and videos.
    """

    photos: Annotated[Path, tyro.conf.Positional]
    """Folder of the photographs, with cameras or without; or a video."""
    out: Path | None = None
    """Folder for everything that is written; by default runs/<name of the photographs>."""
    quick: bool = False
    """1,000 steps at a tenth of a megapixel, for a first look; by default 2,000 at a fifth."""
    quality: bool = False
    """5,000 steps at half a megapixel."""
    again: Annotated[Step | None, tyro.conf.arg(name="from")] = None
    """Do this step and those after it again: what they wrote is deleted."""
    frames: int = 16
    """Pictures to take from a video: the sharpest of as many equal parts."""
    points: str = "auto"
    """Initial points, as for `ca-reg train`, such as "dense"."""
    test: Literal["none", "auto"] = "none"
    """"auto" holds photographs out to measure the quality at, as `ca-reg train` does; by default all of them train."""
    open: bool = True
    """Open the page in a browser, where there is one."""
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    @property
    def folder(self) -> Path:
        """Where everything is written."""
        return self.out or Path("runs", self._name)

    @property
    def _name(self) -> str:
        """Name of the photographs, of a video without its ending."""
        place = self.photos.resolve()
        return place.name if place.is_dir() else place.stem

    def check(self) -> None:
        if not self.photos.exists():
            raise FileNotFoundError(f"there is no {self.photos}: give the folder of the photographs, or a video.")
        if self.quick and self.quality:
            raise ValueError("--quick and --quality exclude each other: give one.")
        if self.frames < 2:
            raise ValueError(f"expected at least 2 --frames of a video, got {self.frames}.")
        if self.folder.resolve() in self.photos.resolve().parents:
            raise ValueError(f"the photographs are in {self.folder}, to which nothing is written: give another --out.")
        others = (run.SCENE, run.CONFIG, run.CHECKPOINT, run.PLY, run.RESULTS, run.VIEWS, run.COMPARISON)
        run.check_output(self.folder, self.photos, () if (self.folder / MARK).exists() else others)
        run.report_file([self.folder])

    def __call__(self) -> None:
        from reference_trainer.runs.run import run_experiment

        scene = self._photographs()
        self.rendering.begin(self.device, trains=True)
        options, config = self._settings(scene)
        self._begin_again("evaluate", "report")  # only now: other settings are refused with all results in place
        print(self._forecast(scene, options, config), flush=True)
        self._poses(scene)
        run_experiment(options, config, self.folder, auto=True, device=self.device, progress=True)
        self._report()

    def _photographs(self) -> Path:
        """Name what cannot be read, and return the folder of the scene: that of the photographs if it has cameras."""
        from reference_trainer.evaluation.results import write_json
        from reference_trainer.scenes.load import find_reader  # from where all formats are known
        from reference_trainer.scenes.photographs import collect_photographs, is_video, sort_photographs

        sources, wrong = sort_photographs(self.photos)
        for name, why in wrong.items():
            print(f"not read, and left out: {'' if name in why else f'{name}: '}{why}", file=sys.stderr)
        scene, mark = self.folder / run.SCENE / self._name, self.folder / MARK
        with suppress(ValueError, FileNotFoundError):
            find_reader(self.photos, "auto")
            scene = self.photos
        if scene != self.photos and find_spec("pycolmap") is None:
            raise ImportError("these photographs have no cameras, and finding them needs pip install 'ca_reg[colmap]'.")
        if scene != self.photos and len(sources) < 2 and not any(map(is_video, sources)):
            held = f"{len(sources) or 'no'} photograph{'s' * (len(sources) != 1)}"
            raise ValueError(f"{self.photos} holds {held} that can be read; it takes at least 2, better 3 or more.")
        about: dict[str, Any] = {"frames": self.frames, "files": {path.name: path.stat().st_size for path in sources}}
        with run.run_lock(self.folder):
            if self.again == "photographs":  # else those that changed are refused with everything in place
                self._begin_again("photographs", "poses", "train")
            before = read_json(mark) if mark.exists() else {}
            if not before:
                write_json(mark, before)  # the folder is ours from now on, should this be interrupted
                names = [] if scene == self.photos else collect_photographs(sources, scene / "images", self.frames)
                write_json(mark, about)
                print(f"photographs: {len(names)}, in {scene}" if names else f"photographs with cameras: {scene}")
            elif before != about:
                changed = {name for name, _ in about["files"].items() ^ before["files"].items()} or {"--frames"}
                raise ValueError(
                    f"{self.folder} was made from other photographs, see {', '.join(sorted(changed))}: give another "
                    "--out, or begin again with --from photographs."
                )
            elif scene != self.photos:  # where they were put, by the name that the photographs had then
                scene = next((images.parent for images in (self.folder / run.SCENE).glob("*/images")), scene)
            self._begin_again("poses", "train")
        return scene

    def _sizes(self, scene: Path) -> tuple[tuple[int, int], int]:
        """Return width and height of the largest photograph, and how many there are, placed or not."""
        from reference_trainer.scenes.images import image_size, list_images
        from reference_trainer.scenes.load import find_reader

        if scene == self.photos:
            paths = [frame.path for frame in find_reader(scene, "auto")(scene, SceneOptions(str(scene))).frames]
        else:
            paths = list_images(scene / "images")
        return max(map(image_size, paths), key=math.prod), len(paths)

    def _makes_dense_start(self, options: SceneOptions, count: int, *, posed: bool) -> bool:
        """Return whether the training begins with a dense start; how many points `poses` leaves is not known before."""
        from reference_trainer.scenes.dense import THIN, made_unasked
        from reference_trainer.scenes.load import load_scene

        if self.points != "auto":
            return self.points == "dense"
        if not posed or not made_unasked(0, count):
            return made_unasked(THIN, count)
        scene = load_scene(options, trains=False)
        return made_unasked(len(scene.points.positions), len(scene.train))

    def _begin_again(self, *steps: Step) -> None:
        """Delete what these steps wrote, as far as `--from` says."""
        order = list(_WRITTEN)
        for step in steps:
            if self.again and order.index(step) >= order.index(self.again):
                for path in [path for name in _WRITTEN[step] for path in self.folder.glob(name)]:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _settings(self, scene: Path) -> tuple[SceneOptions, TrainConfig]:
        """Return what is trained; refuses to go on with a run that was begun with other settings, which are named."""
        steps, pixels = PRESETS["quick" if self.quick else "quality" if self.quality else "default"]
        factor = max(1.0, math.sqrt(math.prod(self._sizes(scene)[0]) / pixels))
        options = SceneOptions(str(scene), test=self.test, points=self.points, downscale=round(factor, 3))
        config = with_recipe(RECIPE, iterations=steps)
        if (self.folder / run.CONFIG).exists():
            try:
                run.settings_of_run(self.folder, options, config, auto=True, given=())
            except ValueError as error:
                raise ValueError(f"{error} Or train again with --from train.") from error
        return options, config

    def _forecast(self, scene: Path, options: SceneOptions, config: TrainConfig) -> str:
        """Return how long what is still to be done will take, from a few training steps on this machine.

        A real training step takes `_TRAINING` times as long as a timed one in the mean, because Gaussians grow in
        number; all else is counted in timed steps too, so that it scales with the machine. On a card, what the
        processor does is taken to last as on the machine of `_REFERENCE`.
        """
        from reference_trainer.runs.warmup import step_seconds
        from reference_trainer.scenes.colmap import colmap_folders
        from reference_trainer.scenes.dense import matched_size
        from reference_trainer.scenes.poses import FEW, feature_size
        from reference_trainer.training.checkpoint import load_checkpoint

        if (self.folder / run.RESULTS).exists():
            return "Trained and measured before."
        (width, height), count = self._sizes(scene)
        factor, done = options.downscale or 1.0, 0
        if (self.folder / run.CHECKPOINT).exists():
            done = load_checkpoint(self.folder / run.CHECKPOINT)["step"]
        size = round(width / factor), round(height / factor)
        pixels, step = math.prod(size), step_seconds(*size, self.device)
        core = step if self.device == "cpu" else _REFERENCE * pixels  # cameras and points are found by the processor
        times, posed = {}, scene == self.photos or bool(colmap_folders(scene))
        if not posed:
            megapixels = math.prod(feature_size(width, height, few=count < FEW)) / 1e6
            work = count * megapixels * (10.0 if count < FEW else 2.0) + 0.025 * count * (count - 1) / 2
            times["poses"] = core / (_REFERENCE * pixels) * work
        if not done and self._makes_dense_start(options, count, posed=posed):
            times["points"] = core * _MATCHED * count * math.prod(matched_size(*size)) / pixels
        times["training"] = step * _TRAINING * (config.iterations - done)
        times["scores and page"] = step * _SHOWN * 3 * min(count, 8)
        parts = ", ".join(f"{name} {_duration(seconds)}" for name, seconds in times.items())
        return f"This will take about {_duration(sum(times.values()))} on this machine as it is now: {parts}."

    def _poses(self, scene: Path) -> None:
        """Find the cameras of photographs that have none."""
        from reference_trainer.scenes.colmap import colmap_folders
        from reference_trainer.scenes.poses import find_poses

        if scene == self.photos:
            return
        if found := colmap_folders(scene):
            print(f"poses: in {found[0]}, as before")
            return
        with run.run_lock(self.folder):
            print(find_poses(scene, progress=True))

    def _report(self) -> None:
        """Write the page and open it."""
        from reference_trainer.evaluation.tables import print_table, summary
        from reference_trainer.report.page import write_report

        page, results = self.folder / "report.html", self.folder / run.RESULTS
        print_table(summary(run.read_results(self.folder)))
        if not page.exists() or page.stat().st_mtime < results.stat().st_mtime:
            write_report([self.folder], device=self.device)
        else:
            print(f"The report is {page}, as before.")
        out = shlex.quote(str(self.folder))
        print(f"Live: ca-reg view {out}; a film: ca-reg render {out} --what flight")
        screen = not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
        if self.open and screen:
            with suppress(webbrowser.Error):
                webbrowser.open(page.resolve().as_uri())


def _duration(seconds: float) -> str:
    """Return a time as people say it.

    Example:
        >>> _duration(42), _duration(200), _duration(5000)
        ('40 s', '3 min', '1 h 23 min')
    """
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
