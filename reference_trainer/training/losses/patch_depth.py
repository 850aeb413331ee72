"""DNGaussian's comparison of the rendered depth with a depth prior, patch by patch."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import unfold

from ca_reg._check import check_count, check_finite
from ca_reg.schedules import Schedule
from reference_trainer.training.losses.term import PriorTerm
from reference_trainer.training.step import Step

__all__ = ["PatchDepth", "patch_error"]

_HARD_OPACITY = 0.95


class PatchDepth(PriorTerm):
    """``weight * (near * local + far * global)`` of DNGaussian (CVPR 2024), each a `patch_error` of rendered depth.

    Patches tile the view without overlap; their side is drawn at each step, separately for the two parts. The source
    takes an optimizer step for each pass; here they are terms of one loss: ``patch_depth(which="hard") +
    patch_depth(which="soft")``.

    Args:
        weight: at least 0, or a schedule. The source's separate steps of Adam have none; in one loss 1 can make all
            Gaussians transparent, see docs/losses_and_density.md.
        near: weight of the local part.
        far: weight of the global part.
        smallest: side of the smallest patch, pixels, at least 2; 17 on DTU.
        largest: side of the largest, 53 on DTU.
        tolerance: differences up to this cost nothing; 0.01 on DTU.
        which: ``"plain"`` for the render of the step; ``"hard"`` for one with all opacities 0.95, of which only the
            positions learn; ``"soft"`` for one of the plain model, of which only the opacities learn. The source begins
            the soft pass at step 1,000.

    Raises:
        TypeError: if ``smallest`` or ``largest`` is no integer.
        ValueError: if one is out of range or not finite.
    """

    def __init__(
        self,
        weight: float | Schedule = 0.01,
        near: float = 0.1,
        far: float = 1.0,
        smallest: int = 5,
        largest: int = 17,
        tolerance: float = 2.5e-4,
        which: Literal["plain", "hard", "soft"] = "plain",
    ) -> None:
        super().__init__(weight)
        for name, value in (("near", near), ("far", far), ("tolerance", tolerance)):
            check_finite(value, name, minimum=0)
        check_count(smallest, "smallest", minimum=2)
        check_count(largest, "largest", minimum=smallest, hint=", less than smallest")
        if which not in ("plain", "hard", "soft"):
            raise ValueError(f"which must be plain, hard or soft, got {which!r}.")
        self.near, self.far, self.tolerance, self.which = near, far, tolerance, which
        self.smallest, self.largest = smallest, largest

    def value(self, step: Step) -> Tensor:
        """Compare the depth of one render."""
        depth, prior = self._depth(step), step.view.depth_prior
        assert prior is not None
        generator = step.generator("patch_depth")
        sides = torch.randint(
            self.smallest, self.largest + 1, (2,), generator=generator, device=generator.device
        ).tolist()
        local = patch_error(depth, prior, sides[0], self.tolerance)
        return self.near * local + self.far * patch_error(depth, prior, sides[1], self.tolerance, overall=True)

    def _depth(self, step: Step) -> Tensor:
        if self.which == "plain":
            return step.depth
        names, x = ("opacities", "means", "scales", "quaternions", "sh"), step.params
        fixed = x._replace(**{name: getattr(x, name).detach() for name in names})
        if self.which == "hard":
            fixed = fixed._replace(means=x.means, opacities=torch.full_like(x.opacities, _HARD_OPACITY))
        else:
            fixed = fixed._replace(opacities=x.opacities)
        depth = step.render(step.view.camera, fixed, depth=True).depth
        assert depth is not None
        return depth


def patch_error(depth: Tensor, prior: Tensor, side: int, tolerance: float, *, overall: bool = False) -> Tensor:
    """Return the mean squared difference of two pictures, their patches normalized, where it exceeds a tolerance.

    A patch is centered and divided by its standard deviation, or with ``overall`` by that of the whole picture, through
    which no gradient goes; in either case plus 0.01 times that of all patches.

    Args:
        depth: shape (H, W).
        prior: nan where unknown, shape (H, W); patches with such pixels are left out.
        side: of the patches, pixels; rows and columns beyond the last whole patch are left out.
        tolerance: of normalized differences.
        overall: whether to divide by the contrast of the picture, DNGaussian's global part, instead of the patch's.

    Returns:
        A scalar, 0 if nothing differs by more or no patch is known.

    Example:
        >>> depth = torch.rand(12, 12, dtype=torch.float64)
        >>> round(patch_error(depth, 3 * depth + 1, 4, 1e-6).item(), 12)
        0.0
    """
    side = min(side, *depth.shape)
    known, flat = prior.isfinite(), []
    whole = unfold(known[None, None].to(depth), side, stride=side)[0].amin(0) > 0
    if not bool(whole.any()):
        return depth.sum() * 0
    for image in (depth, prior):
        patches = unfold(image[None, None], side, stride=side)[0].T[whole]
        spread = image[known].std().detach() if overall else patches.std(dim=1, keepdim=True)
        flat.append((patches - patches.mean(dim=1, keepdim=True)) / (spread + 0.01 * patches.std()).clamp_min(1e-12))
    difference = flat[0] - flat[1]
    beyond = difference.abs() > tolerance
    return difference[beyond].square().sum() / beyond.sum().clamp_min(1)
