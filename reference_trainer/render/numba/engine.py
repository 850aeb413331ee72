"""The engine of compiled loops: float32 on a CPU, the same bits for any number of threads."""

from __future__ import annotations

from torch import Tensor

from reference_trainer.render.numba.binning import bin_gaussians
from reference_trainer.render.numba.compositing import absolute_gradients, composite, composite_masks
from reference_trainer.render.numba.moments import moments, shares
from reference_trainer.render.numba.projection import project
from reference_trainer.render.splats import Splats

__all__ = ["NumbaEngine"]


class NumbaEngine:
    """See `Engine`."""

    name = "numba"

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Keep the lists: the loops skip splats that are too faint."""
        return splats._replace(opacities=opacities)

    project = staticmethod(project)
    bin = staticmethod(bin_gaussians)
    composite = staticmethod(composite)
    composite_masks = staticmethod(composite_masks)
    absolute_gradients = staticmethod(absolute_gradients)
    moments = staticmethod(moments)
    shares = staticmethod(shares)
