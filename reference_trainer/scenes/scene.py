"""Scenes as the rest of the program sees them: photographs with cameras, and initial points."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from reference_trainer.camera import Camera

if TYPE_CHECKING:
    from reference_trainer.model.gaussians import Gaussians

__all__ = ["PointCloud", "Scene", "View", "Viewpoint"]

_NAMES_SHOWN = 12


@dataclass(frozen=True)
class Viewpoint:
    """A named camera; with its photograph it is a `View`."""

    name: str  # a label, unique within its split
    camera: Camera

    def to(self, device: torch.device | str) -> Self:
        """Return the view on another device."""
        parts = ((each.name, getattr(self, each.name)) for each in fields(self))
        moved: dict[str, Any] = {name: x.to(device) for name, x in parts if isinstance(x, Tensor | Camera)}
        return replace(self, **moved)


@dataclass(frozen=True)
class View(Viewpoint):
    """One photograph with its camera, both of one size."""

    image: Tensor  # colors in [0, 1], shape (3, H, W), float32, composited on the background; over 1 by an exposure
    alpha: Tensor | None = None  # coverage in [0, 1], shape (H, W), if the source has one
    depth: Tensor | None = None  # true depth along the camera's z axis, shape (H, W), if known; 0 where nothing is hit
    mask: Tensor | None = None  # what counts in an evaluation, in [0, 1], shape (H, W); it is not applied to the image
    depth_prior: Tensor | None = None
    """What a loss may compare depth with, larger where farther, of unknown scale and shift, shape (H, W): a depth, or a
    negated inverse depth; nan where unknown."""
    exposure: Tensor | None = None
    """By how much the photograph was brighter than the scene's others, shape (3,), if `image` was divided by it."""

    def over(self, background: Tensor, before: Tensor) -> View:
        """Return the view over another background than the one ``before``, both (3,), where it is transparent."""
        if self.alpha is None or background is before:
            return self
        return replace(self, image=self.image + (1 - self.alpha) * (background - before)[:, None, None])

    def as_taken(self, image: Tensor) -> Tensor:
        """Return the image (3, H, W), or a render of this view, with the photograph's own exposure."""
        return image if self.exposure is None else image * self.exposure[:, None, None]


@dataclass(frozen=True)
class PointCloud:
    """Points to initialize Gaussians from: world coordinates and RGB in [0, 1], both (M, 3), float32.

    ``source`` says for the log where they come from; ``seen_by`` names all images that they were triangulated from, if
    that is known; ``confidence`` is in [0, 1], (M,), where the points were measured by a dense start.
    """

    positions: Tensor
    colors: Tensor
    source: str
    seen_by: frozenset[str] | None = None
    confidence: Tensor | None = None


@dataclass(frozen=True)
class Scene:
    """A scene: training and test views and the points to start from."""

    name: str  # short label for reports
    train: tuple[View, ...]  # views to fit
    test: tuple[View, ...]  # held-out views, never used in training
    points: PointCloud  # initial points
    background: Tensor  # the color (3,) behind everything, in [0, 1]
    source: str = "built in"  # where the photographs come from
    notes: tuple[str, ...] = ()  # what a user should know about how it was loaded, one note each
    start: Gaussians | None = None  # a model to start from instead of points; ``points`` are then its centers

    def __str__(self) -> str:
        """Summarize the scene: source and size of the photographs, names of the views, and the notes."""
        sizes = sorted({(view.camera.width, view.camera.height) for view in (*self.train, *self.test)})
        size = " to ".join(f"{width}x{height}" for width, height in dict.fromkeys((sizes[0], sizes[-1])))
        lines = [f"photographs: {self.source}, used at {size} pixels"]
        for kind, views in (("training", self.train), ("test", self.test)):
            names = [view.name for view in views]
            shown = names if len(names) <= _NAMES_SHOWN else [*names[: _NAMES_SHOWN - 1], "...", names[-1]]
            lines.append(f"{len(names)} {kind} view{'s' * (len(names) != 1)}{': ' * bool(names)}{', '.join(shown)}")
        return "\n".join([*lines, *self.notes])

    @property
    def pixels(self) -> int:
        """Pixels of the largest view."""
        return max(view.camera.width * view.camera.height for view in (*self.train, *self.test))

    @property
    def is_white(self) -> bool:
        """Whether the background is white."""
        return bool((self.background == 1).all())

    @property
    def shows_background(self) -> bool:
        """Whether training photographs may show it: by an alpha channel, or over 1 % of all pixels have its color.

        No channel of such a pixel is off by more than 0.05.
        """
        if any(view.alpha is not None for view in self.train):
            return True
        alike = [(view.image - self.background[:, None, None]).abs().amax(0) <= 0.05 for view in self.train]
        return float(torch.cat([pixels.flatten() for pixels in alike]).float().mean()) > 0.01

    @property
    def extent(self) -> float:
        """Radius of the training rig: 1.1 x the largest distance of a training camera from their mean position.

        Convention: the INRIA code scales its position learning rate and its densification thresholds by this number.
        A rig without a radius, such as a single camera, gives 1.
        """
        positions = torch.stack([view.camera.position for view in self.train])
        radius = (positions - positions.mean(0)).norm(dim=1).max().item()
        return 1.1 * radius if radius > 0 else 1.0
