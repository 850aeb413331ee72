"""Measure and remove co-adaptation in sparse-view 3D Gaussian Splatting, in any code base.

- :class:`GaussianDropout` and :class:`OpacityNoise` regularize the activated opacities on their way to the rasterizer;
  :class:`Chain` combines them. :func:`scale_opacity` and :func:`expected_opacity` are their test-time counterparts.
- :class:`CAScore` measures co-adaptation with any render callable: by sampling, or exactly if the renderer offers
  moments. :class:`CAMonitor` logs it during training, and :func:`attribute` tells which Gaussians it comes from.
- :class:`CAPenalty` replaces sampled dropout or noise in training by the expected render, with the exact co-adaptation
  as a term of the loss; the renderer must offer moments.
- :func:`error_map` expects the error of every pixel of a view that has no photograph.
- :class:`Regularizer` and :class:`IndependentDropout` are the base classes of regularizers of your own.

The modules hold the rest: :mod:`ca_reg.regularizers` all regularizers by name, :mod:`ca_reg.schedules` rates that
change during training, :mod:`ca_reg.decay` the decay of opacities, :mod:`ca_reg.functional` the pure functions,
:mod:`ca_reg.types` what a render callable may return, :mod:`ca_reg.lists` exact moments from per-pixel lists,
:mod:`ca_reg.attribution` and :mod:`ca_reg.result` what scores return, :mod:`ca_reg.monitor` plots of a log.

After "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting", called "the paper" throughout.
Importing this package loads torch and numpy only.
"""

from ca_reg.attribution import attribute
from ca_reg.chain import Chain
from ca_reg.error_maps import ErrorMap, error_map
from ca_reg.functional import expected_opacity, scale_opacity
from ca_reg.monitor import CAMonitor
from ca_reg.penalty import CAPenalty
from ca_reg.regularizer import Draw, Params, Regularizer
from ca_reg.regularizers import GaussianDropout, IndependentDropout, OpacityNoise
from ca_reg.result import CAResult, Reason
from ca_reg.score import CAScore

__version__ = "0.2.0"

__all__ = [  # noqa: RUF022  # in the order in which one meets them, which the API page follows
    "GaussianDropout", "OpacityNoise", "Chain", "CAScore",
    "CAResult", "Reason", "CAMonitor", "CAPenalty", "attribute", "error_map", "ErrorMap",
    "IndependentDropout", "Regularizer", "Params", "Draw", "scale_opacity", "expected_opacity",
    "__version__",
]  # fmt: skip
