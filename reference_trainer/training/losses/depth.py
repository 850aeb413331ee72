"""Terms that look at the rendered depth: its correlation with a prior, its smoothness, another view of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from kornia.filters import spatial_gradient
from kornia.geometry import create_meshgrid, remap
from kornia.losses import inverse_depth_smoothness_loss
from torch import Tensor
from torch.nn.functional import unfold

from ca_reg._check import check_count, check_finite
from ca_reg.neighbors import nearest_neighbors
from ca_reg.schedules import Schedule
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.losses.term import PriorTerm, WeightedTerm
from reference_trainer.training.step import Step

__all__ = ["PatchDepth", "Pearson", "SmoothDepth", "Warp", "edge_aware_smoothness", "patch_error", "warp_horizontally"]


class Pearson(PriorTerm):
    """``weight * min(1 - r(D, d), 1 - r(1 / (offset - D), d))``: r Pearson's correlation, d the rendered depth (FSGS).

    D is the prior, larger where farther; for an inverse depth, such as MiDaS's, it is the negative of the file, and the
    two readings are the source's ``-file`` and ``1 / (file + 200)``. The second counts only where the prior spans a
    good part of the offset. Pixels without a prior are left out; without contrast in depth or prior, r is 0.

    Args:
        weight: at least 0, or a schedule. The source uses 0.05, and 0.001 after step 9,500.
        offset: larger than every D; None for the first reading alone.
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
        # A prior may be a depth or an inverse depth up to scale: the reading that fits better counts.
        readings = [prior] if self.offset is None else [prior, 1 / (self.offset - prior)]
        centered = [each - each.mean() for each in (depth, *readings)]
        # Pearson's correlation is the cosine of the centered vectors; 0 where one has no contrast.
        correlations = [torch.cosine_similarity(centered[0], reading, dim=0) for reading in centered[1:]]
        return 1 - torch.stack(correlations).amax()


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
        # All parameters are constants but those that this pass is to move.
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

    The pictures are (H, W); patches of ``side`` pixels tile them without the rows and columns beyond the last whole
    one, and those with a pixel unknown to the prior (nan) are left out. A patch is centered and divided by its standard
    deviation, or with ``overall``, DNGaussian's global part, by that of the whole picture, through which no gradient
    goes; in either case plus 0.01 times that of all patches. A scalar, 0 if nothing differs by more or no patch is
    known.

    Example:
        >>> depth = torch.rand(12, 12, dtype=torch.float64)
        >>> round(patch_error(depth, 3 * depth + 1, 4, 1e-6).item(), 12)
        0.0
    """
    # A patch with an unknown pixel has no mean to compare: only whole ones count.
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


class SmoothDepth(WeightedTerm):
    """``weight`` times kornia's inverse_depth_smoothness_loss of ``alpha / depth`` over its mean (Monodepth2, 2019).

    ``sum over x and y of mean |dD| exp(-mean |dI|)``: forward differences, I the photograph, D the inverse mean depth
    of a pixel, 0 where nothing is rendered, divided by its own mean so that the unit of length does not matter. An
    analytic step has no depth: there the plain model is rendered for it.

    Args:
        weight: at least 0, or a schedule. Monodepth2 uses 0.001, the recipe ``sparse`` 0.1 after a third of the steps.
    """

    needs = frozenset({"depth"})
    analytic = True

    def __init__(self, weight: float | Schedule = 0.001) -> None:
        super().__init__(weight)

    def value(self, step: Step) -> Tensor:
        """Return the smoothness of the view."""
        rendering = step.rendering or step.render(step.view.camera, depth=True)
        assert rendering.depth is not None
        inverse = rendering.alpha / rendering.depth.clamp_min(1e-8)
        inverse = inverse / inverse.mean().clamp_min(1e-12)
        return inverse_depth_smoothness_loss(inverse[None, None], step.view.image[None])


class Warp(WeightedTerm):
    """``weight * (mean|M (warped - photograph)| + smooth * smoothness(M disparity))`` of Binocular3DGS (NeurIPS 2024).

    A camera shifted along its x axis by t, drawn from -shift to shift, is rendered with the plain model and warped back
    by the disparity ``-fx t / (depth + 1e-5)`` of the step's render; M is 1 where the warp stays inside. Our own
    ``hidden`` sets the first M to 0 where something stands between the shifted camera and what the pixel shows.

    Args:
        weight: at least 0, or a schedule. The source begins at step 20,000 of 30,000: ``between(1.0, 20_000)``.
        shift: largest shift, above 0, world units; or, if ``relative``, distances between cameras.
        smooth: weight of the smoothness, at least 0.
        relative: whether shifts count in distances from a training camera to the nearest other one, in the mean over
            them, so that the unit of length does not matter. Where all cameras are in one place the term is left out.
        hidden: largest difference between the depth of the step's render and that of the shifted one, warped back, as a
            share of the former, above 0; what differs more is hidden. None takes nothing for hidden.
        every: steps from one with the term to the next.
    """

    needs = frozenset({"depth"})

    def __init__(
        self,
        weight: float | Schedule = 1.0,
        shift: float = 0.4,
        smooth: float = 0.05,
        relative: bool = False,
        hidden: float | None = None,
        every: int = 1,
    ) -> None:
        super().__init__(weight)
        check_count(every, "every", minimum=1)
        for name, value in (("shift", shift), ("hidden", hidden)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}.")
        check_finite(smooth, "smooth", minimum=0)
        self.shift, self.smooth, self.relative, self.hidden, self.every = shift, smooth, relative, hidden, every
        self._unit = 1.0  # of shifts, in the world's

    def begin(self, scene: Scene) -> None:
        """Measure how far apart the training cameras are."""
        if self.relative:
            positions = torch.stack([view.camera.position for view in scene.train])
            squares = nearest_neighbors(positions, 1)[0] if len(positions) > 1 else torch.zeros(1)
            self._unit = squares.sqrt().mean().item()

    def acts(self, number: int) -> bool:
        """Return whether the step is one of those with the term, its weight is not 0, and there is a shift."""
        return number % self.every == 0 and self._unit > 0 and super().acts(number)

    def value(self, step: Step) -> Tensor:
        """Render the shifted camera and compare."""
        camera, photograph, generator = step.view.camera, step.view.image, step.generator("warp")
        shift = self.shift * self._unit * (2 * torch.rand((), generator=generator, device=generator.device) - 1).item()
        pose = camera.world_to_camera.clone()
        # x_camera = R x + t: moving the camera by +shift along its own x axis lowers t_x.
        pose[0, 3] -= shift
        shifted = step.render(replace(camera, world_to_camera=pose), depth=self.hidden is not None)
        disparity = -camera.fx * shift / (step.depth + 1e-5)
        warped, inside = warp_horizontally(shifted.image, disparity)
        seen = inside
        if self.hidden is not None:
            assert shifted.depth is not None
            # A shift along x changes no depth: a point that both cameras see has the same in both.
            there, _ = warp_horizontally(shifted.depth.detach()[None], disparity.detach())
            seen = inside * ((there[0] - step.depth).abs() < self.hidden * step.depth)
        error = (seen * (warped - photograph)).abs().mean()
        # The smoothness is not masked by it: at the border of a hole it would pull the disparity to 0.
        return error + self.smooth * edge_aware_smoothness(inside * disparity, photograph)


def warp_horizontally(image: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor]:
    """Sample a picture (C, H, W) a disparity (H, W), in pixels, to the right of every pixel.

    Returns the picture, bilinearly interpolated, and a mask (H, W) of zeros and ones: where that stays inside.

    Example:
        >>> image, disparity = torch.arange(4.0).expand(1, 2, 4), torch.full((2, 4), 0.5)
        >>> warped, inside = warp_horizontally(image, disparity)
        >>> (inside * warped)[0, 0].round(decimals=4).tolist(), inside[0].tolist()
        ([0.5, 1.5, 2.5, 0.0], [1.0, 1.0, 1.0, 0.0])
    """
    height, width = disparity.shape
    x, y = create_meshgrid(height, width, normalized_coordinates=False, device=image.device, dtype=image.dtype)[
        0
    ].unbind(-1)
    x = x + disparity
    # Bilinear interpolation needs a pixel to the right.
    inside = (x >= 0) & (x < width - 1)
    return remap(image[None], x[None], y[None], align_corners=True)[0], inside.to(image.dtype)


def edge_aware_smoothness(disparity: Tensor, image: Tensor) -> Tensor:
    """Return ``mean |exp(-0.33 |dI|) dD|`` along x plus along y: central differences, I the sum of the channels.

    The disparity D is (H, W), the picture (C, H, W); the border pixels are left out.

    Example:
        >>> edge_aware_smoothness(torch.arange(5.0).expand(4, 5), torch.zeros(3, 4, 5)).item()
        1.0
    """
    images = torch.stack([image.sum(0), disparity])
    edges, steps = spatial_gradient(images[None], mode="diff")[0, :, :, 1:-1, 1:-1]
    smoothness: Tensor = (torch.exp(-0.33 * edges.abs()) * steps).abs().mean((-2, -1)).sum()
    return smoothness
