"""`ca-reg run`: from photographs to a model and its page, in steps that each resume."""

from __future__ import annotations

import math
import os
import shlex
import shutil
import statistics
import sys
import webbrowser
import zlib
from collections.abc import Collection
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
from reference_trainer.threads import processors, thread_count
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import with_recipe

__all__ = ["Run"]

RECIPE = "sparse"
"""The best setting known for few photographs."""
PRESETS = {"quick": (1_000, 100_000), "default": (2_000, 200_000), "quality": (5_000, 500_000)}
"""Training steps, and pixels to which photographs are reduced."""
FAR = 4.0
"""Photographs of so many times more or fewer pixels than most are named: all are reduced by one factor."""
MARK = "photographs.json"
Step = Literal["photographs", "poses", "train", "evaluate", "report"]
_WRITTEN: dict[Step, tuple[str, ...]] = {
    "photographs": (run.SCENE, MARK),
    "poses": (f"{run.SCENE}/*/sparse",),
    "train": (
        run.CHECKPOINT,
        run.CONFIG,
        run.PLAN,
        run.PLY,
        run.BAKED_PLY,
        run.GUARD,
        run.GUARD_PICTURE,
        "ca.jsonl",
        "events.out.*",
        run.MEMBERS,
    ),
    "evaluate": (run.RESULTS, "evaluation.partial.json", run.VIEWS),
    "report": ("report.html",),
}
"""What each step writes. `--from` deletes that of a step and of those after it, the last first: without the mark the
folder would be somebody else's."""

_TRAINING, _SHOWN, _MATCHED, _REFERENCE = 2.0, 30.0, 115.0, 2.9e-7
"""Of `_forecast`: a training step, measuring and showing a view, and a photograph of the dense start if it is matched
at the size of the training, all in timed steps; seconds of such a step per pixel on the machine on which the seconds of
the poses were measured."""
_DISTILLED, _WARPED = 1_100, 1.8
"""A distillation's 300 steps, and a step of a training with a warp in its loss, in steps of a training."""


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
    members: int = 1
    """Models to train, the others half as long as the first, and to distill into one, which errs less where few
    photographs look: 2, of other seeds, take 1.8 times the processor time of one to train; of 3, 2.5 times, the second
    has slower means and the third Binocular3DGS's warp. They train side by side where processors would be idle."""
    again: Annotated[Step | None, tyro.conf.arg(name="from")] = None
    """Do this step and those after it again: what they wrote is deleted."""
    frames: int = 16
    """Pictures to take from a video: the sharpest of as many equal parts."""
    points: str = "auto"
    """Initial points, as for `ca-reg train`, such as "dense"."""
    test: Literal["none", "auto"] = "none"
    """"auto" holds photographs out to measure the quality at, as `ca-reg train` does; by default all of them train."""
    one_exposure: bool = True
    """Make photographs of different exposure or white balance equally bright."""
    open: bool = True
    """Open the page in a browser, where there is one."""
    device: Device = "cpu"
    rendering: Rendering = field(default_factory=RenderOptions)

    @property
    def folder(self) -> Path:
        """Where everything is written."""
        return self.out or Path("runs", self._name)

    @property
    def _trained(self) -> list[Path]:
        """The folders of the trainings, of one the folder itself."""
        places = [self.folder / run.MEMBERS / str(number) for number in range(self.members)]
        return places if self.members > 1 else [self.folder]

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
        if self.members < 1:
            raise ValueError(f"expected at least 1 of --members, got {self.members}.")
        if self.frames < 2:
            raise ValueError(f"expected at least 2 --frames of a video, got {self.frames}.")
        if self.folder.resolve() in self.photos.resolve().parents:
            raise ValueError(f"the photographs are in {self.folder}, to which nothing is written: give another --out.")
        SceneOptions(test=self.test, points=self.points)  # refuses what no scene has
        others = (
            MARK, run.SCENE, run.MEMBERS, run.CONFIG, run.CHECKPOINT, run.PLY, run.RESULTS, run.VIEWS, run.COMPARISON,
        )  # fmt: skip
        run.check_output(self.folder, self.photos, () if self._mark() else others)
        run.report_file([self.folder])

    def __call__(self) -> None:
        from reference_trainer.runs.distill import distilled
        from reference_trainer.runs.run import Monitoring, run_experiment

        self.rendering.choose(self.device)
        scene = self._photographs()
        self.rendering.begin(self.device, trains=True, points=True)
        options, config = self._settings(scene)
        if self.again not in (None, "photographs"):  # only now: what is refused is refused with everything in place
            with run.run_lock(self.folder):
                self._begin_again()
        print(self._forecast(scene, options, config), flush=True)
        self._poses(scene)
        if several := self.members > 1:
            if not (self.folder / run.RESULTS).exists():
                self._train_members(options, config)
            options, config = distilled(self._trained)
        run_experiment(
            options, config, self.folder, auto=not several, device=self.device, progress=True,
            monitoring=Monitoring(pictures=True),
        )  # fmt: skip
        self._report()

    def _photographs(self) -> Path:
        """Put the photographs in place, and return the folder of the scene: their own if they have cameras."""
        from reference_trainer.evaluation.results import write_json
        from reference_trainer.scenes.formats import camera_files
        from reference_trainer.scenes.photographs import collect_photographs

        sources, scene = self._sources()
        files = {path.name: _checksum(path) for path in sources}
        if scene == self.photos:
            files |= {path.relative_to(scene).as_posix(): _checksum(path) for path in camera_files(scene)}
        about: dict[str, Any] = {"frames": self.frames, "files": files}
        with run.run_lock(self.folder):
            if self.again != "photographs" and (place := self._in_place(about, scene)):
                return place
            names, part = list[str](), self.folder / ".photographs.part"
            shutil.rmtree(part, ignore_errors=True)  # left by a process that was killed
            try:
                if scene != self.photos:
                    names = collect_photographs(sources, part, self.frames)
                    _check_number(len(names), f"{', '.join(path.name for path in sources)} gave", "picture")
                if self.again == "photographs":
                    self._begin_again()
                write_json(self.folder / MARK, about)  # the folder is ours from now on
                if names:
                    shutil.rmtree(scene / "images", ignore_errors=True)  # which holds nothing
                    scene.mkdir(parents=True, exist_ok=True)
                    part.rename(scene / "images")
            finally:
                shutil.rmtree(part, ignore_errors=True)
            print(f"photographs: {len(names)}, in {scene}" if names else f"photographs with cameras: {scene}")
        return scene

    def _sources(self) -> tuple[list[Path], Path]:
        """Return photographs and videos, and the folder of their scene; name, or refuse, what cannot be used."""
        from reference_trainer.scenes.load import find_reader  # from where all formats are known
        from reference_trainer.scenes.photographs import is_video, sort_photographs, unread_folders

        sources, wrong = sort_photographs(self.photos)
        scene = self.folder / run.SCENE / self._name
        with suppress(ValueError, FileNotFoundError):
            find_reader(self.photos, "auto")
            scene = self.photos
        wrong |= {} if scene == self.photos else unread_folders(self.photos, self.folder)
        for name, why in wrong.items():
            print(f"left out: {'' if name in why else f'{name}: '}{why}", file=sys.stderr)
        if scene == self.photos:
            self._sizes(scene)  # cameras that cannot be read are refused before anything is written
        elif find_spec("pycolmap") is None:
            raise ImportError("these photographs have no cameras, and finding them needs pip install 'ca_reg[colmap]'.")
        elif not any(map(is_video, sources)):
            _check_number(len(sources), f"{self.photos} holds", "photograph", " that can be read")
        return sources, scene

    def _mark(self) -> dict[str, Any] | None:
        """Return what an earlier call noted of the photographs; None if nothing, or the file is somebody else's."""
        with suppress(OSError, ValueError):
            match mark := read_json(self.folder / MARK):
                case {"frames": int(), "files": dict() as files} if all(isinstance(x, int) for x in files.values()):
                    return dict(mark)
        return None

    def _in_place(self, about: dict[str, Any], scene: Path) -> Path | None:
        """Return the folder of the scene if an earlier call has put the same photographs there; refuse others."""
        from reference_trainer.scenes.photographs import is_video

        before = self._mark()
        if before is None:
            return None
        changed = {name for name, _ in about["files"].items() ^ before["files"].items()}
        if before["frames"] != self.frames and any(is_video(Path(name)) for name in about["files"]):
            changed.add("--frames")
        if changed:
            raise ValueError(
                f"{self.folder} was made from other photographs or cameras, see {', '.join(sorted(changed))}: give "
                "another --out, or begin again with --from photographs."
            )
        if scene == self.photos:
            return scene
        # By the name that the photographs had then.
        return next((path.parents[1] for path in (self.folder / run.SCENE).glob("*/images/*")), None)

    def _sizes(self, scene: Path) -> dict[Path, tuple[int, int]]:
        """Return width and height of every photograph, placed or not."""
        from reference_trainer.scenes.images import image_size, list_images
        from reference_trainer.scenes.load import find_reader

        if scene == self.photos:
            paths = [frame.path for frame in find_reader(scene, "auto")(scene, SceneOptions(str(scene))).frames]
        else:
            paths = list_images(scene / "images")
        return {path: image_size(path) for path in paths}

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

    def _begin_again(self) -> None:
        """Delete what the step of `--from` and those after it wrote."""
        assert self.again is not None
        steps = list(_WRITTEN)
        for step in reversed(steps[steps.index(self.again) :]):
            for path in [path for name in _WRITTEN[step] for path in self.folder.glob(name)]:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _settings(self, scene: Path) -> tuple[SceneOptions, TrainConfig]:
        """Return what is trained; refuses to go on with a run that was begun with other settings, which are named."""
        from reference_trainer.runs.distill import distilled
        from reference_trainer.scenes.images import path_inside

        cloud, written = path_inside(scene, self.points), "sparse/0"  # by the poses
        if self.points.partition(":")[0] not in ("auto", "dense", "random", written) and not cloud.exists():
            raise FileNotFoundError(f"there is no {cloud} for --points: give auto, dense, random or one that is there.")
        steps, pixels = PRESETS["quick" if self.quick else "quality" if self.quality else "default"]
        factor = max(1.0, math.sqrt(math.prod(_usual(self._sizes(scene).values())) / pixels))
        options = SceneOptions(
            str(scene), test=self.test, points=self.points, downscale=round(factor, 3), one_exposure=self.one_exposure
        )
        config = with_recipe(RECIPE, iterations=steps)
        if self.again not in ("poses", "train"):
            try:
                if begun := (self._trained[0] / run.CONFIG).exists():
                    run.settings_of_run(self._trained[0], options, config, auto=True, given=())
                if self.members > 1 and (self.folder / run.CONFIG).exists():
                    if not begun:
                        raise ValueError(f"{self.folder} holds one model of its own: give another --out.")
                    run.settings_of_run(self.folder, *distilled(self._trained), auto=False, given=())
            except ValueError as error:
                raise ValueError(f"{error} Or train again with --from train.") from error
        return options, config

    def _members(self, config: TrainConfig) -> list[tuple[Path, TrainConfig]]:
        """Return folder and settings of every training but that of their distillation."""
        from reference_trainer.runs.distill import member_settings

        settings = (member_settings(config, number, self.members) for number in range(self.members))
        return [*zip(self._trained, settings, strict=True)]

    def _jobs(self, pixels: int) -> int:
        """Return how many trainings run side by side: as many as have processors for all threads that one uses."""
        return min(self.members, max(1, processors() // thread_count(pixels)))

    def _train_members(self, options: SceneOptions, config: TrainConfig) -> None:
        """Train the models that the last training learns from, side by side."""
        from reference_trainer.runs import grid
        from reference_trainer.runs.executors import Failure, Processes
        from reference_trainer.scenes.load import load_scene

        scene = load_scene(options)  # with its dense start, which is kept: else each would make its own
        models = [
            grid.Run(f"model {number}", options, own, folder)
            for number, (folder, own) in enumerate(self._members(config), start=1)
        ]
        running = grid.Running(Processes(self._jobs(scene.pixels)), device=self.device, auto=True, progress=True)
        for model, outcome in zip(models, grid.run_grid(models, running), strict=True):
            if isinstance(outcome, Failure):
                raise RuntimeError(f"{model.label} failed, {outcome.error} The same command tries it again.")

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
        full, factor, new, measured = self._sizes(scene), options.downscale or 1.0, False, 1
        sizes = {path: (max(1, round(w / factor)), max(1, round(h / factor))) for path, (w, h) in full.items()}
        count, usual = len(sizes), _usual(sizes.values())
        busy = [0.0] * (jobs := self._jobs(math.prod(usual)))  # for so many steps
        for folder, own in self._members(config):
            begun = (folder / run.CHECKPOINT).exists()
            left = own.iterations - (load_checkpoint(folder / run.CHECKPOINT)["step"] if begun else 0)
            busy[busy.index(min(busy))] += left * (_WARPED if "warp(" in own.loss else 1)
            new |= not begun
        steps = max(busy)
        if self.members > 1:  # the last training is of steps that render several models
            steps, measured = steps + _DISTILLED, math.ceil(self.members / jobs) + 1
        pixels = statistics.fmean(map(math.prod, sizes.values()))
        step = step_seconds(*usual, self.device) * pixels / math.prod(usual)
        core = step if self.device == "cpu" else _REFERENCE * pixels  # cameras and points are found by the processor
        times, posed = {}, scene == self.photos or bool(colmap_folders(scene))
        if not posed:
            megapixels = sum(math.prod(feature_size(*size, few=count < FEW)) for size in full.values()) / 1e6
            work = megapixels * (10.0 if count < FEW else 2.0) + 0.025 * count * (count - 1) / 2
            times["poses"] = core / (_REFERENCE * pixels) * work
        if new and self._makes_dense_start(options, count, posed=posed):
            matched = sum(math.prod(matched_size(*size)) for size in sizes.values())
            times["points"] = core * _MATCHED * matched / pixels  # kept for the other members
        times["training"] = step * _TRAINING * steps
        times["scores and page"] = measured * step * _SHOWN * 3 * min(count, 8)
        parts = ", ".join(f"{name} {_duration(seconds)}" for name, seconds in times.items())
        ratios = {path: math.prod(size) / math.prod(usual) for path, size in sizes.items()}
        far = [f"{path.name} at {w}x{h}" for path, (w, h) in sizes.items() if not 1 / FAR <= ratios[path] <= FAR]
        about = f"By one factor for all, most photographs train at {usual[0]}x{usual[1]}, but {', '.join(far)}.\n"
        total = _duration(sum(times.values()))
        return f"{about * bool(far)}This will take about {total} on this machine as it is now: {parts}."

    def _poses(self, scene: Path) -> None:
        """Find the cameras of photographs that have none."""
        from reference_trainer.scenes.colmap import colmap_folders
        from reference_trainer.scenes.poses import find_poses, left_out

        if scene == self.photos:
            return
        if found := colmap_folders(scene):
            print("\n".join([f"poses: in {found[0]}, as before", *left_out(scene)]))
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


def _check_number(number: int, whose: str, what: str, which: str = "") -> None:
    """Refuse fewer than two pictures with a ValueError."""
    if number < 2:
        held = f"{number or 'no'} {what}{'s' * (number != 1)}{which}"
        raise ValueError(f"{whose} {held}; it takes at least 2, better 3 or more.")


def _usual(sizes: Collection[tuple[int, int]]) -> tuple[int, int]:
    """Return the median size, of two the larger.

    Example:
        >>> _usual([(640, 480), (4000, 3000), (640, 480)])
        (640, 480)
    """
    return sorted(sizes, key=math.prod)[len(sizes) // 2]


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


def _checksum(path: Path) -> int:
    """Return a number that changes with the content of a file."""
    total = 0
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            total = zlib.crc32(part, total)
    return total
