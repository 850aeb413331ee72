"""The engine of Triton kernels: float32 on a card, or with ``TRITON_INTERPRET=1`` on a CPU, for tests."""

from __future__ import annotations

from torch import Tensor

from reference_trainer.render.splats import Splats
from reference_trainer.render.triton.binning import bin_gaussians
from reference_trainer.render.triton.compositing import absolute_gradients, composite, composite_masks
from reference_trainer.render.triton.moments import moments, shares
from reference_trainer.render.triton.projection import project

__all__ = ["TritonEngine"]


class TritonEngine:
    """See `Engine`. Gradients are sums by atomics, or in one order where PyTorch is asked for deterministic ones."""

    name = "triton"

    def masked(self, splats: Splats, opacities: Tensor) -> Splats:
        """Keep the lists: the kernels skip splats that are too faint."""
        return splats._replace(opacities=opacities)

    project = staticmethod(project)
    bin = staticmethod(bin_gaussians)
    composite = staticmethod(composite)
    composite_masks = staticmethod(composite_masks)
    absolute_gradients = staticmethod(absolute_gradients)
    moments = staticmethod(moments)
    shares = staticmethod(shares)
