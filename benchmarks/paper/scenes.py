"""The declared scenes of the study with their protocols; no initial points have seen test views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.losses import LOSSES
from reference_trainer.training.losses.term import PriorTerm

__all__ = ["PAPER_SIZE", "PAPER_STEPS", "SCENES", "PaperScene", "chosen_scenes"]


@dataclass(frozen=True)
class PaperScene:
    """A scene and how the grid uses it.

    Args:
        options: the scene; the path of a declared one is relative to the data folder.
        about: its protocol in words.
        depth: the depth option for losses with a depth prior.
    """

    options: SceneOptions
    about: str = "a scene of one's own"
    depth: str = "points"

    def below(self, data: Path) -> PaperScene:
        """Return the scene with its folder below that of the data."""
        path = self.options.path
        return self if path == "synthetic" else replace(self, options=replace(self.options, path=str(data / path)))

    def options_for(self, setting: Mapping[str, Any], loss: str) -> SceneOptions:
        """Return the scene for a training: with the setting's number of views, and with depth if its loss needs one.

        With another number of views the initial points stay those of the scene's own training views.
        """
        options = self.options
        if "views" in setting:
            options = replace(options, views=setting["views"], allow_test_points=True)
        if options.depth is None and any(isinstance(term, PriorTerm) for term in LOSSES.make(loss)):
            options = replace(options, depth=self.depth)
        return options

    @property
    def dense(self) -> SceneOptions:
        """The scene with all photographs, including test views: its model is the reference for depth."""
        return replace(self.options, test="none", views=None, allow_test_points=True)


_NEAR = {"images": "images", "split": "split_near", "points": "sparse_3near/0", "downscale": 1.5}
_DTU = {"split": "dtu", "points": "sparse_3views_dense/0", "downscale": 1.5}

SCENES = {
    "synthetic": PaperScene(SceneOptions(), "built in, 160x120, 3 and 3 views, true depth", depth="true"),
    "fern": PaperScene(
        SceneOptions("fern", images="images_16", split="llff", points="sparse_3views_dense/0"),
        "LLFF, 252x189, 3 and 3 views, 15,000 stereo points of the training views",
    ),
    "lego": PaperScene(
        SceneOptions("lego", downscale=1.5, points="random"),
        "NeRF-synthetic, 267x267 over white, 8 and 25 views, 10,000 random points",
    ),
    "dtu-scan65": PaperScene(
        SceneOptions("dtu-scan65", **_DTU),  # type: ignore[arg-type]
        "DTU, 267x200, views 25, 22, 28 and the 25 of the test, 8,000 stereo points of the training views; PSNR inside "
        "the masks, SSIM and LPIPS over the masked picture",
    ),
    "fountain": PaperScene(
        SceneOptions("fountain", **_NEAR),  # type: ignore[arg-type]
        "256x171, near split of 3 and 2 views, 5,064 points of the training views",
    ),
    "herz-jesu": PaperScene(
        SceneOptions("herz-jesu", **_NEAR),  # type: ignore[arg-type]
        "256x171, near split of 3 and 2 views, 3,484 points of the training views",
    ),
    "dtu-scan24": PaperScene(
        SceneOptions("dtu-scan24", **_DTU),  # type: ignore[arg-type]
        "DTU, 256x256, the same views, 8,000 points; without masks, so that the table counts",
    ),
    "sceaux": PaperScene(
        SceneOptions("sceaux", split="split", points="sparse_3views_dense/0"),
        "a castle, 384x288, 3 and 4 views, 10,000 stereo points of the training views; exposure varies",
    ),
    "cape": PaperScene(
        SceneOptions("cape", split="split", points="sparse_3views_dense/0"),
        "the Mold gold cape, 304x304, 3 and 8 views, 10,000 stereo points of the training views; PSNR inside the "
        "masks, SSIM and LPIPS over the masked picture",
    ),
}
"""The declared scenes by name, the cheapest first."""

PAPER_SIZE = {
    "fern-504": PaperScene(replace(SCENES["fern"].options, images="images_8"), "fern at 504x378"),
    "lego-400": PaperScene(replace(SCENES["lego"].options, downscale=1.0), "lego at 400x400"),
    "dtu-scan65-400": PaperScene(replace(SCENES["dtu-scan65"].options, downscale=1.0), "DTU scan65 at 400x300"),
    "dtu-scan24-384": PaperScene(replace(SCENES["dtu-scan24"].options, downscale=1.0), "DTU scan24 at 384x384"),
}
"""Scenes of the paper's data sets again, with pictures of its size."""

PAPER_STEPS = 10_000
"""Steps of the trainings at the paper's size."""


def chosen_scenes(names: Sequence[str], data: Path, own: SceneOptions) -> dict[str, PaperScene]:
    """Return the scenes of a study by name.

    Args:
        names: of the declared scenes; none for all.
        data: where their folders are.
        own: the user's own scene instead, if it has a path.

    Raises:
        ValueError: if a scene is not declared, both declared scenes and an own one are given, or options of an own one
            that has no path.
    """
    if own.path:
        if names:
            raise ValueError(f"give declared scenes or --path, not both: got {[*names]} and {own.path}.")
        name = own.path if own.path == "synthetic" else Path(own.path).resolve().name
        return {name: PaperScene(own, depth="true" if own.path == "synthetic" else "points")}
    if own != SceneOptions(""):
        raise ValueError("the options of a scene apply to one of your own, the declared ones have theirs: give --path.")
    every = SCENES | PAPER_SIZE
    if unknown := [name for name in names if name not in every]:
        raise ValueError(f"there is no declared scene {unknown[0]}; choose of {', '.join(every)}, or give --path.")
    return {name: every[name].below(data) for name in names or every}
