"""Measure and remove co-adaptation in sparse-view 3D Gaussian Splatting, in any code base.

- :class:`GaussianDropout` and :class:`OpacityNoise` regularize the activated opacities on their way to the rasterizer;
  :func:`scale_opacity` and :func:`expected_opacity` are their test-time counterparts.
- :class:`CAScore` measures co-adaptation with any render callable: by sampling, or exactly if the renderer offers
  moments, which :class:`ListMoments` computes from per-pixel lists; :func:`attribute` and :func:`total_effects` tell
  which Gaussians it comes from. :class:`CAMonitor` logs it during training, and :func:`color_variance` is the paper's
  second metric.
- :class:`CAPenalty` replaces sampled dropout or noise in training by the expected render, with the exact co-adaptation
  as a term of the loss; the renderer must offer moments.
- :mod:`ca_reg.functional` has the pure functions, :mod:`ca_reg.schedules` rates that change during training,
  :mod:`ca_reg.types` what a render callable may return, :mod:`ca_reg.dynamics` plots of a monitor's log.

After "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting", called "the paper" throughout.
Importing this package loads torch and numpy only.
"""

from ca_reg import functional
from ca_reg.attribution import CAAttribution, CATotalEffects, SharesFn, attribute, total_effects
from ca_reg.chain import Chain
from ca_reg.functional import ColorVariance, color_variance, expected_opacity, scale_opacity
from ca_reg.lists import ListMoments, PixelLists
from ca_reg.monitor import CAMonitor
from ca_reg.params import Draw, Params
from ca_reg.penalty import CAPenalty
from ca_reg.reason import Reason
from ca_reg.regularizer import Learned, Regularizer
from ca_reg.regularizers import GaussianDropout, IndependentDropout, OpacityNoise
from ca_reg.result import CAResult, CASummary, summarize
from ca_reg.schedules import Constant, LinearRamp, Schedule, StartStop
from ca_reg.score import CAScore
from ca_reg.types import MomentsFn, RenderFn, Rendering

__version__ = "0.2.0"

__all__ = [
    "CAAttribution",
    "CAMonitor",
    "CAPenalty",
    "CAResult",
    "CAScore",
    "CASummary",
    "CATotalEffects",
    "Chain",
    "ColorVariance",
    "Constant",
    "Draw",
    "GaussianDropout",
    "IndependentDropout",
    "Learned",
    "LinearRamp",
    "ListMoments",
    "MomentsFn",
    "OpacityNoise",
    "Params",
    "PixelLists",
    "Reason",
    "Regularizer",
    "RenderFn",
    "Rendering",
    "Schedule",
    "SharesFn",
    "StartStop",
    "__version__",
    "attribute",
    "color_variance",
    "expected_opacity",
    "functional",
    "scale_opacity",
    "summarize",
    "total_effects",
]
