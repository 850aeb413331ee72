"""What is added to a splatfacto model: regularized Gaussians, and the co-adaptation score among its image metrics."""

from __future__ import annotations

import functools
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise
from ca_reg.regularizers import parse

from .gsplat import Rasterization, regularized

__all__ = ["CoAdaptation"]

_of_the_model: ContextVar[Rasterization | None] = ContextVar("_of_the_model", default=None)


class _Dispatch:
    """Stands in for `rasterization` in a module: calls that of the model which renders, else the original."""

    def __init__(self, original: Rasterization) -> None:
        self.original = original
        functools.update_wrapper(self, original)

    def __call__(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        out: tuple[Any, ...] = (_of_the_model.get() or self.original)(*args, **kwargs)
        return out


_Splatfacto: Any = object  # the class that comes next in the order of inheritance


class CoAdaptation(_Splatfacto):  # type: ignore[misc]
    """Comes before `SplatfactoModel` among the bases of a model; the config has the fields that are read here.

    The regularizers are no submodules: checkpoints are those of splatfacto, and load either way.
    """

    holder: ModuleType
    """The module whose name `rasterization` the renders of the model look up."""

    def populate_modules(self) -> None:
        """Make the parts of the model, and what regularizes and measures it."""
        super().populate_modules()
        if not isinstance(self.holder.rasterization, _Dispatch):
            self.holder.rasterization = _Dispatch(self.holder.rasterization)  # type: ignore[attr-defined]
        self._original: Rasterization = self.holder.rasterization.original
        config = self.config
        chain, p = Chain(GaussianDropout(config.dropout), OpacityNoise(config.opacity_noise)), config.dropout
        if config.regularizer:
            chain, p = parse(config.regularizer), 0.0
        self._regularized = regularized(self._original, chain)
        self._score: CAScore | None = None
        if config.ca_samples > 0:
            self._score = CAScore(self._render, samples=config.ca_samples, p=p, layout="HWC")
        self._cameras: MutableMapping[Tensor, Any] = WeakTensorKeyDictionary()

    def get_outputs(self, camera: Any) -> dict[str, Any]:
        """Render a camera: with regularized Gaussians in training, with test-time ones in evaluation."""
        if self.training:
            self._regularized.chain.set_step(self.step)
        with _rasterizing_by(self._regularized if self.training else self._regularized.evaluate):
            outputs: dict[str, Any] = super().get_outputs(camera)
        if not self.training and self.crop_box is None and "rgb" in outputs:
            self._cameras[outputs["rgb"]] = camera
        return outputs

    def update_to_step(self, step: int) -> None:
        """Take note of the step of a checkpoint that is loaded, which schedules follow in evaluation."""
        super().update_to_step(step)
        self._regularized.chain.set_step(step)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Measure an evaluation image; adds `ca`, `ca_std_error`, `ca_visible`, and a picture `ca`.

        They are left out if ``outputs["rgb"]`` is not what this model has just rendered, whole and in evaluation.
        """
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        camera = self._cameras.get(outputs["rgb"])
        if self._score is not None and camera is not None:
            opacity = torch.sigmoid(self.opacities.detach()).squeeze(-1)
            result = self._score(opacity, camera, index=int(batch.get("image_idx", 0)))
            metrics["ca"] = result.value
            metrics["ca_std_error"] = result.std_error
            metrics["ca_visible"] = float(result.visible.double().mean())
            images["ca"] = result.variance.sqrt().float().unsqueeze(-1).expand(-1, -1, 3)
        return metrics, images

    def _render(self, opacity: Tensor, camera: Any) -> dict[str, Tensor]:
        """Render a camera with these activated opacities instead of the model's own."""

        def rasterization(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
            out: tuple[Any, ...] = self._original(*args, **{**kwargs, "opacities": opacity})
            return out

        with _rasterizing_by(rasterization):
            outputs = super().get_outputs(camera)
        return {name: outputs[name] for name in ("rgb", "accumulation")}


@contextmanager
def _rasterizing_by(rasterization: Rasterization) -> Iterator[None]:
    """Let this thread rasterize by a function of the model for a while; the viewer renders in a thread of its own."""
    token = _of_the_model.set(rasterization)
    try:
        yield
    finally:
        _of_the_model.reset(token)
