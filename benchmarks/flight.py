"""The moving picture of the README: ``python -m benchmarks.flight RUN_A RUN_B --out docs/images/fern.webp``.

The runs of that picture, of about two minutes each on one core, are ``ca-reg train fern --images images_16 --points
sparse_3views_dense/0 --recipe 3dgs --iterations 3000``, once as it is and once with ``--dropout 0.2 --opacity-decay
0.995``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import tyro

from reference_trainer.camera import Camera
from reference_trainer.evaluation.evaluate import CA_PICTURE_RANGE
from reference_trainer.evaluation.pictures import as_pillow, heat_map, label_font
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.files import replacing
from reference_trainer.runs.measure import load_run_model
from reference_trainer.scenes.scene import Viewpoint
from reference_trainer.scenes.virtual_cameras import camera_between

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["flight", "sheets", "there_and_back"]

_GAP, _HEAD, _BAR = 4, 22, 62  # pixels: between pictures, of a line of text, of the color bar with its numbers
_UNIT = "× 10⁻³"  # noqa: RUF001


def there_and_back(cameras: Sequence[Camera], frames: int, past: float) -> list[Camera]:
    """Return the way there of a loop through cameras; it slows down at its ends, ``past`` segments beyond the last.

    Played there and back, without the ends twice, ``frames`` cameras are a loop of ``2 * frames - 2`` pictures.
    """
    last, path = len(cameras) - 1, []
    for frame in range(frames):
        along = last / 2 - (last / 2 + past) * math.cos(math.pi * frame / (frames - 1))
        i = min(max(int(along), 0), last - 1)
        path.append(camera_between(cameras[i], cameras[i + 1], along - i))
    return path


@torch.no_grad()
def sheets(models: Sequence[TrainedModel], labels: Sequence[str], path: Sequence[Camera]) -> list[Image]:
    """Return a picture for each camera: a column for each model, its render above the exact variance of the pixels."""
    from PIL import Image, ImageDraw

    width, height = path[0].width, path[0].height
    font = label_font()
    columns, scores = list[list[tuple[Image.Image, Image.Image]]](), list[str]()
    for model in models:
        score = model.exact_ca_score(drop_rate=0.5)
        views = [Viewpoint("", camera) for camera in path]
        results = [score(model.gaussians.opacities, view) for view in views]
        renders = [as_pillow(model.test_rendering(view).image) for view in views]
        columns.append(
            list(
                zip(renders, (as_pillow(heat_map(r.variance.float(), CA_PICTURE_RANGE)) for r in results), strict=True)
            )
        )
        scores.append(f"exact co-adaptation: {1e3 * sum(r.value for r in results) / len(results):.1f} {_UNIT}")
    sheet = Image.new("RGB", (len(models) * (width + _GAP) + _BAR, 2 * (height + _HEAD)), "white")
    pen, bottom = ImageDraw.Draw(sheet), 2 * _HEAD + height
    for i, texts in enumerate(zip(labels, scores, strict=True)):
        for row, text in enumerate(texts):
            pen.text((i * (width + _GAP) + 2, row * (_HEAD + height) + 2), text, fill="black", font=font)
    left = len(models) * (width + _GAP)
    ramp = heat_map(torch.linspace(1, 0, height)[:, None].expand(height, 16), 1.0)
    sheet.paste(as_pillow(ramp), (left, bottom))
    for part in range(5):
        text, at = f"{1e3 * CA_PICTURE_RANGE * part / 4:g}", bottom + (height - 1) * (4 - part) / 4
        pen.text((left + 20, min(max(at, bottom + 7), bottom + height - 8)), text, fill="black", font=font, anchor="lm")
    pen.text((left, bottom - _HEAD + 2), _UNIT, fill="black", font=font)
    pictures = []
    for number in range(len(path)):
        pictures.append(sheet.copy())
        for i, of in enumerate(columns):
            for row, picture in enumerate(of[number]):
                pictures[-1].paste(picture, (i * (width + _GAP), _HEAD + row * (_HEAD + height)))
    return pictures


def flight(
    runs: tyro.conf.Positional[tuple[Path, Path]],
    /,
    out: Path = Path("docs/images/fern.webp"),
    labels: Annotated[tuple[str, str], tyro.conf.arg(metavar="A B")] = (
        "without a regularizer",
        "with dropout and opacity decay",
    ),
    width: int = 378,
    frames: int = 22,
    past: float = 0.6,
    milliseconds: int = 90,
    quality: int = 55,
) -> None:
    """Fly through the training cameras of two runs on one scene, and write a looping WebP.

    Args:
        runs: their folders.
        out: the file.
        labels: what stands above their pictures.
        width: of each picture, pixels.
        frames: of the way there; the way back shows them again.
        past: how far beyond the outer training cameras, in segments of the path.
        milliseconds: for which each is shown.
        quality: of the compression, 0 to 100.
    """
    models, scenes = zip(*(load_run_model(run, "cpu") for run in runs), strict=True)
    cameras = sorted((view.camera for view in scenes[0].train), key=lambda camera: camera.position[0].item())
    height = round(width * cameras[0].height / cameras[0].width)
    path = [camera.resized(width, height) for camera in there_and_back(cameras, frames, past)]
    pictures = sheets(models, labels, path)
    with replacing(out) as place:
        pictures[0].save(
            place, "WEBP", save_all=True, append_images=[*pictures[1:], *pictures[-2:0:-1]], duration=milliseconds,
            loop=0, quality=quality, method=6,
        )  # fmt: skip
    print(f"{out}: {2 * frames - 2} pictures of {pictures[0].size}, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    tyro.cli(flight)
