"""Variants of the CA score at one view of a model: the paper's protocol, its limits, and what lies between them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier
from ca_reg.types import read_moments
from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.trained_model import TrainedModel
from reference_trainer.scenes.scene import View

__all__ = ["VARIANTS", "score_view"]

VARIANTS = {
    "protocol": "the paper's protocol: 5 renders at drop rate 1 - (1 - p)/2, over the pixels that all of them cover",
    "protocol_half": "the same at drop rate 1/2 for every model",
    "repeat": "protocol_half with other masks",
    "unconditioned": "the renders of protocol_half over the region of exact_half",
    "exact": "variance at the protocol's drop rate, over the pixels of expected alpha above 0.8",
    "exact_half": "the same at drop rate 1/2 for every model",
    "limit_conditioned": "the variance of exact_half over the region of protocol_half",
    "weighted_half": "the variance of exact_half over all pixels, weighted by their expected alpha",
    "neutral_half": "exact_half composited over the expected color instead of the background",
}
"""The scores that are compared, in the order of the tables."""

_HALF = 0.5


@torch.no_grad()
def score_view(model: TrainedModel, view: View, *, index: int) -> dict[str, float]:
    """Measure all variants at one view.

    Args:
        model: what to measure.
        view: a view on the model's device.
        index: its position in its split, which decides the masks as it does in `evaluate`.

    Returns:
        PSNR of the test-time render, every variant by name, and under ``"visible NAME"`` the share of the pixels in
        the region of the variants that have one of their own; nan where the region of a variant is empty.
    """
    opacities = model.gaussians.opacities
    moments = read_moments(model.moments(opacities, view, Multiplier.dropout(_HALF)), layout="CHW")
    assert moments.alpha_mean is not None
    exact_half = CAScore.exact(lambda *_: moments, drop_rate=_HALF)(opacities, view)
    half = model.ca_score(drop_rate=_HALF)(opacities, view, index=index)
    repeat = model.ca_score(drop_rate=_HALF, seed=1)(opacities, view, index=index)
    neutral = model.exact_ca_score(drop_rate=_HALF, neutral=True)(opacities, view)
    if model.dropout > 0:
        protocol = model.ca_score()(opacities, view, index=index)
        exact = model.exact_ca_score()(opacities, view)
    else:
        protocol, exact = half, exact_half
    results = {
        "protocol": protocol,
        "protocol_half": half,
        "repeat": repeat,
        "exact": exact,
        "exact_half": exact_half,
        "neutral_half": neutral,
    }
    values = {name: result.value for name, result in results.items()}
    values["unconditioned"] = _average(half.variance, exact_half.visible)
    values["limit_conditioned"] = _average(exact_half.variance, half.visible)
    values["weighted_half"] = _average(exact_half.variance, moments.alpha_mean)
    image = model.test_rendering(view).image.clamp(0, 1)
    return {
        "psnr": psnr(image, view.image),
        **{name: values[name] for name in VARIANTS},
        **{
            f"visible {name}": result.visible.double().mean().item()
            for name, result in results.items()
            if result is not neutral  # the region of exact_half
        },
    }


def _average(values: Tensor, weights: Tensor) -> float:
    """Average (H, W) with weights, or over a region; nan where all weights are 0."""
    weights = weights.double()
    total = weights.sum()
    return ((values.double() * weights).sum() / total).item() if total > 0 else math.nan
