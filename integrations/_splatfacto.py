"""The mixin for splatfacto models: regularized Gaussians, and the co-adaptation score among the image metrics."""

from __future__ import annotations

import functools
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

import torch
from kornia.losses import inverse_depth_smoothness_loss
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from ca_reg import CAScore, Chain, GaussianDropout, OpacityNoise
from ca_reg._check import check_finite
from ca_reg.decay import OpacityDecay
from ca_reg.regularizers import parse

from .gsplat import Rasterization, Regularized, regularized

_of_the_model: ContextVar[Rasterization | None] = ContextVar("_of_the_model", default=None)


class _Dispatch:
    """Stands in for `rasterization` in a module: calls the function of the rendering model, else the original."""

    def __init__(self, original: Rasterization) -> None:
        self.original = original
        functools.update_wrapper(self, original)

    def __call__(self, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        out: tuple[Any, ...] = (_of_the_model.get() or self.original)(*args, **kwargs)
        return out


_Splatfacto: Any = object  # stands for the next class in the MRO


class CoAdaptation(_Splatfacto):  # type: ignore[misc]
    """Mixin to list before `SplatfactoModel` among the bases; the config needs the fields of `SplatfactoCAModelConfig`.

    The regularizers are not submodules: checkpoints are those of splatfacto, and interchangeable with them.
    """

    holder: ModuleType
    """The module in which the model's render looks up `rasterization`."""

    def populate_modules(self) -> None:
        """Create the parts of the model, its regularizers and its score."""
        super().populate_modules()
        check_finite(self.config.smooth_depth, "smooth_depth", minimum=0)
        self.config.output_depth_during_training |= self.config.smooth_depth > 0
        if not isinstance(self.holder.rasterization, _Dispatch):
            self.holder.rasterization = _Dispatch(self.holder.rasterization)  # type: ignore[attr-defined]
        self._original: Rasterization = self.holder.rasterization.original
        config = self.config
        chain, p = Chain(GaussianDropout(config.dropout), OpacityNoise(config.opacity_noise)), config.dropout
        if config.regularizer:
            chain, p = parse(config.regularizer), 0.0
        if isinstance(self._original, Regularized):
            raise ValueError(
                "splatfacto-ca has regularizers of its own, and opacities would be dropped twice: leave out --dropout, "
                "--noise and --regularizer of the launcher, or train splatfacto."
            )
        self._regularized = regularized(self._original, chain)
        self._decay = OpacityDecay(config.opacity_decay, start=config.warmup_length)
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

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Return the losses of splatfacto and, in training, smooth depth, once density control has begun."""
        losses: dict[str, Tensor] = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self.config.smooth_depth > 0 and self.step >= self.config.warmup_length:
            photograph = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
            # Where nothing is rendered, splatfacto's depth is the largest of the picture; here it is infinite.
            inverse = (outputs["accumulation"] > 0) / outputs["depth"].clamp_min(1e-8)
            inverse = inverse / inverse.mean().clamp_min(1e-12)
            smoothness = inverse_depth_smoothness_loss(*(x.permute(2, 0, 1)[None] for x in (inverse, photograph)))
            losses["smooth_depth"] = self.config.smooth_depth * smoothness
        return losses

    def decay_opacities(self, step: int) -> None:
        """Decay the opacities after a training step, counted from 0, once density control has begun."""
        self._decay(self.opacities, step + 1)

    def update_to_step(self, step: int) -> None:
        """Pass the step of a loaded checkpoint to the regularizers, whose schedules follow it in evaluation."""
        super().update_to_step(step)
        self._regularized.chain.set_step(step)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Measure an evaluation image; adds the metrics `ca`, `ca_std_error`, `ca_visible`, and an image `ca`.

        They are left out if ``outputs["rgb"]`` is not a full render of this model in evaluation.
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
    """Let this thread rasterize with the given function; the viewer renders in its own thread."""
    token = _of_the_model.set(rasterization)
    try:
        yield
    finally:
        _of_the_model.reset(token)
