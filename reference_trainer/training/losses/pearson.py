"""FSGS's correlation of the rendered depth with a depth prior."""

from __future__ import annotations

import torch
from torch import Tensor

from ca_reg.schedules import Schedule
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.losses.term import PriorTerm
from reference_trainer.training.step import Step

__all__ = ["Pearson"]


class Pearson(PriorTerm):
    """``weight * min(1 - r(D, d), 1 - r(1 / (offset - D), d))``: r Pearson's correlation, d the rendered depth (FSGS).

    D is the prior, larger where farther; for an inverse depth, such as MiDaS's, it is the negative of the file, and the
    two readings are the source's ``-file`` and ``1 / (file + 200)``. The second counts only where the prior spans a
    good part of the offset. Pixels without a prior are left out; without contrast in depth or prior, r is 0.

    Args:
        weight: at least 0, or a schedule. The source uses 0.05, and 0.001 after step 9,500.
        offset: larger than every D; None for the first reading alone.

    Raises:
        ValueError: if the weight is negative, or a prior reaches the offset.
    """

    def __init__(self, weight: float | Schedule = 0.05, offset: float | None = 200.0) -> None:
        super().__init__(weight)
        self.offset = offset

    def begin(self, scene: Scene) -> None:
        """Refuse priors that are missing or that the offset does not exceed."""
        super().begin(scene)
        if self.offset is not None:
            for view in scene.train:
                assert view.depth_prior is not None
                if (largest := view.depth_prior.nan_to_num(-torch.inf).max().item()) >= self.offset:
                    raise ValueError(
                        f"the depth prior of {view.name} reaches {largest:g}, and 1 / (offset - prior) needs an offset "
                        f"above it, got {self.offset:g}: write pearson(offset=None) for a prior that is a depth."
                    )

    def value(self, step: Step) -> Tensor:
        """Correlate over the pixels of the view."""
        prior = step.view.depth_prior
        assert prior is not None
        known = prior.isfinite()
        prior, depth = prior[known], step.depth[known]
        readings = [prior] if self.offset is None else [prior, 1 / (self.offset - prior)]
        centered = [each - each.mean() for each in (depth, *readings)]
        correlations = [torch.cosine_similarity(centered[0], reading, dim=0) for reading in centered[1:]]
        return 1 - torch.stack(correlations).amax()
