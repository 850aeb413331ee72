"""A trained model, and how it is rendered and scored."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from torch import Tensor

from ca_reg import CAScore, Chain, GaussianDropout, Params
from ca_reg.functional import Multiplier
from ca_reg.regularizers import parse
from ca_reg.types import MomentsFn, RenderFn
from reference_trainer.camera import Camera
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.rendering import arguments, render_gaussians
from reference_trainer.render import render_masks, render_moments, splat, variance_shares
from reference_trainer.render.splats import MomentImages, Rendering, Splats
from reference_trainer.scenes.scene import Viewpoint

__all__ = ["MaskedRenders", "TrainedModel"]


@dataclass(frozen=True)
class TrainedModel:
    """A trained model and how it is used at test time.

    Args:
        gaussians: the parameters.
        background: color behind them, shape (3,).
        regularizer: what it was trained with, an expression for `ca_reg.regularizers.parse`; it decides the test-time
            opacities and the drop rate of the paper's CA protocol.
        step: number of training steps; schedules have the values of the last one.
        sh_degree: highest band of spherical harmonics to use; None for all.
        for_rendering: whether the opacities are the test-time ones already and the plain ones are unknown.
    """

    gaussians: Gaussians
    background: Tensor
    regularizer: str = ""
    step: int = 0
    sh_degree: int | None = None
    for_rendering: bool = False

    @cached_property
    def chain(self) -> Chain:
        """The regularizers it was trained with."""
        return parse(self.regularizer)

    @property
    def dropout(self) -> float:
        """The rate of all uniform, uncompensated dropout combined, in the last step; 0 without any."""
        plain = self.params()
        rates = [m.rates(plain) for m in self.chain if isinstance(m, GaussianDropout) and not m.compensate]
        return 1.0 - math.prod(1.0 - float(rate) for rate in rates)

    @property
    def factor(self) -> float | None:
        """The factor on all opacities at test time; None if it depends on the Gaussian."""
        uniform = all(isinstance(member, GaussianDropout) or not member.renders_mean for member in self.chain)
        return 1.0 - self.dropout if uniform else None

    @property
    def depends_on_camera(self) -> bool:
        """Whether the test-time opacities depend on the camera, so that no file of Gaussians can hold them."""
        return any(member.renders_mean and "view_matrix" in member.needs for member in self.chain)

    @property
    def without_camera(self) -> TrainedModel:
        """The model itself, or if its test-time opacities depend on the camera, the one with plain opacities."""
        return replace(self, regularizer="") if self.depends_on_camera else self

    @property
    def test_opacities(self) -> Tensor:
        """The test-time opacities, shape (N,); only for models where they do not depend on the camera."""
        return self._tested(self.params()).opacities

    def params(self, camera: Camera | None = None) -> Params:
        """Return the activated parameters, with the number of the last step: what its regularizers worked on."""
        # Steps count from 0. At their number a schedule may have ended, such as one that stops with the training.
        return self.gaussians.params(camera, step=max(self.step - 1, 0))

    def _tested(self, x: Params) -> Params:
        return x if self.for_rendering else self.chain.expected(x)

    def test_rendering(self, view: Viewpoint, *, depth: bool = False) -> Rendering:
        """Render a view with the test-time opacities; CA is measured on the plain ones instead, see `render`."""
        tested = self._tested(self.params(view.camera))
        return render_gaussians(tested, view.camera, self.background, sh_degree=self.sh_degree, depth=depth)

    def render(self, opacities: Tensor, view: Viewpoint) -> tuple[Tensor, Tensor]:
        """Render a view with given opacities (N,), the render function of `CAScore`: image (3, H, W), alpha (H, W)."""
        out = render_gaussians(
            self.gaussians, view.camera, self.background, opacities=opacities, sh_degree=self.sh_degree
        )
        return out.image, out.alpha

    def moments(
        self, opacities: Tensor, view: Viewpoint, multiplier: Multiplier, background: Tensor | None = None
    ) -> MomentImages:
        """Render the exact moments of a view under random factors: the ``exact`` function of `CAScore`.

        The background is the model's own, or one of shape (3,) or (3, H, W).
        """
        return render_moments(
            self.splats(opacities, view), multiplier, background=self.background if background is None else background
        )

    def shares(
        self, opacities: Tensor, view: Viewpoint, multiplier: Multiplier, background: Tensor | None, weights: Tensor
    ) -> Tensor:
        """Attribute a weighted sum of the variance to the Gaussians: the shares function of `ca_reg.attribute`.

        The background is the model's own, or one of shape (3,) or (3, H, W); the pixels' weights have shape (H, W). The
        result is float64, shape (N,), 0 for Gaussians outside the view.
        """
        splats = self.splats(opacities, view)
        background = self.background if background is None else background
        shares = variance_shares(splats, multiplier, weights, background=background)
        return splats.to_all(shares, len(self.gaussians))

    def splats(self, opacities: Tensor, view: Viewpoint) -> Splats:
        """Project the model with given opacities (N,) and bin the splats into tiles."""
        return splat(**arguments(self.gaussians, opacities), camera=view.camera, sh_degree=self.sh_degree)

    def ca_score(
        self, *, samples: int = 5, drop_rate: float | None = None, seed: int = 0, render_fn: RenderFn | None = None
    ) -> CAScore:
        """Return the paper's CA protocol for this model; pass a ``render_fn`` if the model still changes."""
        renders = render_fn or MaskedRenders(self)
        return CAScore(renders, samples=samples, p=self.dropout, drop_rate=drop_rate, seed=seed)

    def exact_ca_score(
        self, *, drop_rate: float | None = None, neutral: bool = False, moments: MomentsFn | None = None
    ) -> CAScore:
        """Return the limit of `ca_score` for infinitely many samples, over the pixels of expected alpha above 0.8.

        Pass ``moments``, a function like the method `moments`, if the model still changes.
        """
        return CAScore.exact(moments or self.moments, p=self.dropout, drop_rate=drop_rate, neutral=neutral)


class MaskedRenders:
    """The render function of a `CAScore` for a model that does not change.

    Projection, colors and sorted tile lists are computed once per view, for all Gaussians, and all masks of a view are
    rendered in one pass. The images are those of `TrainedModel.render`.
    """

    def __init__(self, model: TrainedModel) -> None:
        self._model = model
        self._view: Viewpoint | None = None
        self._splats: Splats | None = None

    def __call__(self, opacities: Tensor, view: Viewpoint) -> tuple[Tensor, Tensor]:
        """Render a view with given opacities (N,); image (3, H, W), alpha (H, W)."""
        images, alphas = self.render_batch(opacities[None], view)
        return images[0], alphas[0]

    def render_batch(self, opacities: Tensor, view: Viewpoint) -> tuple[Tensor, Tensor]:
        """Render a view with K sets of opacities (K, N); images (K, 3, H, W), alphas (K, H, W)."""
        plain = self._model.gaussians.opacities
        if bool((opacities > plain).any()):  # the lists for the plain opacities would be too short
            return render_masks(
                self._model.splats(opacities.amax(0), view), opacities, background=self._model.background
            )
        if self._splats is None or view is not self._view:
            self._view, self._splats = view, self._model.splats(plain, view)
        return render_masks(self._splats, opacities, background=self._model.background)
