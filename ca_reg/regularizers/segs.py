"""SE-GS's perturbation of all parameters of a Gaussian except its color."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ca_reg import functional
from ca_reg._check import is_zero
from ca_reg.regularizer import Draw, Params, Regularizer
from ca_reg.schedules import ExponentialDecay

__all__ = ["SEGSNoise"]


class SEGSNoise(Regularizer):
    """Add noise to centers, raw opacities, raw scales and rotations in training (SE-GS, ICCV 2025, its perturbation).

    Each column of the raw parameters (``x, y, z``, the logit of the opacity, the logarithms of the three scales, six
    numbers for the rotation) is shifted by

        n * ratio * max(mean |column|, 1),   n ~ N(0, 1),   ratio = first (last / first)^((t - start) / (stop - start))

    from step ``start`` to ``stop``. The six numbers are the first two rows of the rotation matrix (Zhou et al. 2019),
    orthonormalized again by Gram-Schmidt. ``eval()`` changes nothing, as the source renders its unperturbed model.

    Unlike here, the source trains two models and perturbs the second, every 500 steps, permanently, and only the
    Gaussians under pixels that its first model has rendered differently over time; the trainer's density control
    ``self_ensembling`` does that. The noise does not just multiply alphas, so there is no exact multiplier. The floor
    of 1 on the mean makes the noise of the centers depend on the world unit.

    Args:
        first: the ratio at ``start``, above 0.
        last: the ratio at ``stop``, above 0.
        start: first step with noise. The source collects its first three sets of images until 2,000.
        stop: first step without noise again; 500 before the end of the source's 10,000.

    Example:
        >>> noise = SEGSNoise(start=0)
        >>> x = Params(torch.full((5,), 0.5), torch.zeros(5, 3), torch.ones(5, 3), torch.rand(5, 4))
        >>> bool((noise(x).opacities != x.opacities).all())
        True
        >>> noise.eval()(x) is x
        True
    """

    needs = ("means", "scales", "quaternions")
    drops = False

    def __init__(self, first: float = 0.08, last: float = 0.02, start: int = 2_000, stop: int = 9_500) -> None:
        super().__init__(ExponentialDecay(first, last, start, stop))

    @torch.no_grad()
    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw the noise of centers (N, 3), logits (N, 1), log-scales (N, 3) and rotations (N, 6), float32."""
        ratio = self.rate_at(x.step)
        if is_zero(ratio):
            return Draw()
        means, scales, rows = _geometry(x)
        # Finite even where another regularizer has dropped a Gaussian; in 16 bits, 1 - 1e-6 would be 1.
        logits = x.opacities[:, None].to(torch.promote_types(x.opacities.dtype, torch.float32)).logit(eps=1e-6)
        draws = []
        for raw in (means, logits, scales.log(), rows.flatten(1)):
            noise = functional.draw_opacity_noise(raw.numel(), ratio, generator=generator, device=raw.device)
            draws.append(noise.view(raw.shape) * raw.abs().mean(0).clamp(min=1.0))
        return Draw(tuple(draws))

    def replay(self, x: Params, draw: Draw) -> Params:
        """Add the noise."""
        if draw.value is None:
            return x
        means, scales, rows = _geometry(x)
        given = (means, x.opacities, scales, rows)
        of_means, of_logits, of_scales, of_rows = (n.to(of.dtype) for n, of in zip(draw.value, given, strict=True))
        raised = of_logits[:, 0].exp()  # sigmoid(logit o + n) without the logit, which is infinite at 0 and 1
        return x._replace(
            means=means + of_means,
            opacities=x.opacities * raised / (1.0 + x.opacities * (raised - 1.0)),
            scales=scales * of_scales.exp(),
            quaternions=_quaternions(rows + of_rows.view(-1, 2, 3)),
        )

    def extra_repr(self) -> str:
        """Return the arguments, for ``print``."""
        return repr(self._schedule)


def _geometry(x: Params) -> tuple[Tensor, Tensor, Tensor]:
    """Return centers, scales, and the first two rows of the rotation matrices, (N, 2, 3)."""
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    assert x.means is not None, "checked by check_needs"
    assert x.scales is not None
    assert x.quaternions is not None
    return x.means, x.scales, quaternion_to_rotation_matrix(normalize(x.quaternions, dim=-1))[:, :2]


def _quaternions(rows: Tensor) -> Tensor:
    """Return the quaternions wxyz of the rotations whose first rows these are after Gram-Schmidt."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    first = normalize(rows[:, 0], dim=-1)
    second = normalize(rows[:, 1] - (first * rows[:, 1]).sum(-1, keepdim=True) * first, dim=-1)
    return rotation_matrix_to_quaternion(torch.stack([first, second, torch.linalg.cross(first, second)], dim=1))
