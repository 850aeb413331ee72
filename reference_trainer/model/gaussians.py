"""The parameters of a set of 3D Gaussians, their activations, and several Gaussians in place of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ca_reg import Params
from reference_trainer.camera import Camera

__all__ = ["PARAMETERS", "SH_C0", "Gaussians", "compute_relocation", "positions"]

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")
"""The parameters of every Gaussian, by the names of the fields."""

SH_C0 = 0.28209479177387814  # the constant band of the spherical harmonics: sqrt(1 / (4 pi))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as raw parameters, the way the INRIA code and the PLY files hold them.

    Convention: quaternions are wxyz and need not be normalized; spherical-harmonic colors add 0.5 after evaluation;
    opacities and scales are stored as logits and logarithms.

    Args:
        means: world coordinates, shape (N, 3).
        log_scales: logarithms of the standard deviations along the axes, shape (N, 3).
        quaternions: orientation, wxyz, shape (N, 4).
        opacity_logits: logits of the opacities, shape (N,).
        sh_dc: constant color coefficients, shape (N, 1, 3).
        sh_rest: the other coefficients, shape (N, (degree + 1)^2 - 1, 3).
        learned: what regularizers learn per Gaussian, by name, each (N,).

    Raises:
        ValueError: if the shapes disagree.

    Example:
        >>> gaussians = Gaussians.from_points(torch.rand(10, 3), torch.rand(10, 3), torch.full((10,), 0.1), sh_degree=1)
        >>> len(gaussians), gaussians.sh_degree
        (10, 1)
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    learned: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,)}
        expected |= {"sh_dc": (n, 1, 3), "sh_rest": (n, self.sh_rest.shape[1] if self.sh_rest.ndim == 3 else -1, 3)}
        expected |= {name: (n,) for name in self.learned}
        for name, x in self.named():
            if tuple(x.shape) != expected[name]:
                raise ValueError(f"{name} must have shape {expected[name]}, got {tuple(x.shape)}.")
        if self.sh_rest.shape[1] not in (0, 3, 8, 15):
            raise ValueError(f"sh_rest must hold 0, 3, 8 or 15 coefficients, got {self.sh_rest.shape[1]}.")

    @classmethod
    def from_points(
        cls, positions: Tensor, colors: Tensor, distances: Tensor, *, sh_degree: int, opacity: float = 0.1
    ) -> Gaussians:
        """Make isotropic Gaussians of one opacity, in (0, 1), at positions (N, 3) in the world, of these colors (N, 3).

        Colors are RGB in [0, 1]; ``distances`` (N,), positive, are the standard deviations; ``sh_degree`` is 0 to 3.
        Raises ValueError for values that are not finite or out of range, and if the shapes disagree.
        """
        n = positions.shape[0]
        for name, x in (("positions", positions), ("colors", colors)):
            if not bool(x.isfinite().all()):
                raise ValueError(f"{name} must be finite, got nan or infinity.")
        if not bool(((distances > 0) & distances.isfinite()).all()):
            raise ValueError("distances must be positive and finite: the logarithm of 0 can not be trained.")
        if not 0.0 < opacity < 1.0:
            raise ValueError(f"opacity must be in (0, 1), got {opacity}: its logit would be infinite.")
        quaternions = positions.new_zeros(n, 4)
        quaternions[:, 0] = 1.0
        return cls(
            means=positions.clone(),
            log_scales=distances.log()[:, None].repeat(1, 3),
            quaternions=quaternions,
            opacity_logits=positions.new_full((n,), math.log(opacity / (1 - opacity))),
            sh_dc=((colors - 0.5) / SH_C0)[:, None, :].clone(),
            sh_rest=positions.new_zeros(n, (sh_degree + 1) ** 2 - 1, 3),
        )

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @property
    def opacities(self) -> Tensor:
        """Activated opacities in [0, 1], shape (N,).

        In float32 their gradient is off by more than 1 % for logits above 13, and 0 above 17, where they are 1.
        """
        return torch.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the axes, shape (N, 3)."""
        return torch.exp(self.log_scales)

    @property
    def sh(self) -> Tensor:
        """All color coefficients, shape (N, (degree + 1)^2, 3)."""
        return torch.cat([self.sh_dc, self.sh_rest], dim=1)

    def params(self, camera: Camera | None = None, *, step: int = 0) -> Params:
        """Return the activated parameters that a rasterizer receives and every regularizer works on."""
        view_matrix = None if camera is None else camera.world_to_camera
        return Params(
            self.opacities, self.means, self.scales, self.quaternions, self.sh, view_matrix, self.learned, step
        )

    def named(self) -> Iterator[tuple[str, Tensor]]:
        """Iterate over parameters and their names; those that regularizers learn come last."""
        yield from ((name, getattr(self, name)) for name in PARAMETERS)
        yield from self.learned.items()

    @classmethod
    def from_named(cls, tensors: Mapping[str, Tensor]) -> Gaussians:
        """Make Gaussians of named parameters, as `named` yields them."""
        # Whatever is not a parameter of every Gaussian was learned by a regularizer.
        own = {name: tensors[name] for name in PARAMETERS}
        return cls(**own, learned={name: x for name, x in tensors.items() if name not in PARAMETERS})

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Return Gaussians whose tensors are ``function(tensor)``."""
        return Gaussians.from_named({name: function(tensor) for name, tensor in self.named()})

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        places = index if isinstance(index, slice) else positions(index)
        return self.map(lambda x: x[places])

    def to(self, device: torch.device | str) -> Gaussians:
        """Return the Gaussians on another device."""
        return self.map(lambda x: x.to(device))


def positions(index: Tensor) -> Tensor:
    """Return the positions where a mask is set; positions as they are.

    Use it where one mask selects from several tensors: each selection by a mask makes the host wait for a card.

    Example:
        >>> positions(torch.tensor([True, False, True]))
        tensor([0, 2])
    """
    return index.nonzero()[:, 0] if index.dtype == torch.bool else index


@torch.no_grad()
def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return opacities and scales with which n Gaussians at one place look like one (3DGS-MCMC, equation 9).

    Opacities (N,) or (N, 1) and scales (N, 3) are those of the one; ``ratios`` (N,) holds n, clamped to the size of
    ``binoms``, whose row n and column k is n choose k. New opacities are at least ``min_opacity``, and the scales
    account for it (gsplat 1.6).

    Example:
        >>> table = torch.tensor([[1.0, 0.0], [1.0, 1.0]])
        >>> opacity, scales = compute_relocation(torch.tensor([0.75]), torch.ones(1, 3), torch.tensor([2]), table)
        >>> opacity.item(), round(scales[0, 0].item(), 4)  # 0.75 / (2 x 0.5 - 0.5^2 / sqrt(2))
        (0.5, 0.9111)
    """
    n = ratios.long().clamp(1, len(binoms))
    old = opacities.double().flatten()
    # n layers let as much light pass as the one: (1 - new)^n = 1 - old.
    opacity = (1 - (1 - old) ** (1 / n.double())).clamp_min(min_opacity)
    k = torch.arange(len(binoms), dtype=torch.float64, device=binoms.device)
    # The scales shrink by old / sum_i<n sum_k C(i, k) (-1)^k new^(k + 1) / sqrt(k + 1); the sum over i is the cumsum.
    # The signs of the terms alternate: in single precision they would cancel.
    terms = binoms.double().cumsum(0) * (-1) ** k / (k + 1).sqrt()
    shrink = old / (terms[n - 1] * opacity[:, None] ** (k + 1)).sum(1)
    return opacity.to(opacities).view_as(opacities), scales * shrink[:, None].to(scales)
