"""Stand-ins for small extensions that trainers import: ``simple_knn``, ``fused_ssim``, the encoders of torch-ngp."""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from ca_reg.neighbors import nearest_neighbors
from reference_trainer.compat.outputs import names_of_results
from reference_trainer.training.losses.photometric import ssim_map

__all__ = ["FreqEncoder", "GridEncoder", "Refusing", "SHEncoder", "distCUDA2", "fused_ssim", "make_module"]

BORDER = 5  # pixels that the 11 x 11 window reaches beyond its center


def make_module(name: str, **members: Any) -> ModuleType:
    """Make a module of these members; one that has ``_C`` is a package."""
    module = ModuleType(name, "A stand-in on top of reference_trainer.")
    module.__spec__ = ModuleSpec(name, loader=None, is_package="_C" in members)
    vars(module).update(members, **{"__path__": []} if "_C" in members else {})
    return module


class Refusing:
    """Takes the place of compiled code that is imported; its use raises RuntimeError, its import alone does not."""

    def __init__(self, name: str, advice: str = "run without --cpu, or switch off what calls it") -> None:
        self._name, self._advice = name, advice

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        return Refusing(f"{self._name}.{attribute}", self._advice)

    def __call__(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse."""
        raise RuntimeError(f"{self._name} is compiled code, which needs CUDA and has no stand-in here: {self._advice}.")


def distCUDA2(points: Tensor) -> Tensor | tuple[Tensor, Tensor]:
    """Return mean squared distances to the three nearest neighbors, shape (N,).

    Callers that unpack the result, as FSGS and CoR-GS do, also get the indices of the neighbors, (N, 3) int32.
    """
    squares, indices = nearest_neighbors(points, 3)
    return squares.mean(1) if names_of_results() is None else (squares.mean(1), indices.int())


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM of pictures (B, C, H, W), as `ssim_map` has it; differentiable in the first.

    ``padding`` is "same" for all pixels, zeros beyond the border, or "valid" for those whose window lies inside;
    ``train`` is ignored. Raises ValueError for another padding.

    Example:
        >>> import torch
        >>> picture = torch.rand(1, 3, 16, 16, dtype=torch.float64)
        >>> round(fused_ssim(picture, picture, padding="valid").item(), 6)
        1.0
    """
    if padding not in ("same", "valid"):
        raise ValueError(f"padding must be 'same' or 'valid', got {padding!r}.")
    similarity = ssim_map(img1.flatten(0, 1), img2.detach().flatten(0, 1))
    return (similarity if padding == "same" else similarity[:, BORDER:-BORDER, BORDER:-BORDER]).mean()


PRIMES = (1, 2654435761, 805459861, 3674653429, 2097192037, 1434869437, 2165219737)  # one per dimension
WORD = 2**32 - 1  # hashes are unsigned numbers of 32 bits
GRANULE = 8  # sizes of tables are multiples of it


class GridEncoder(nn.Module):
    """Interpolates features in grids of growing resolution (Mueller et al. 2022, section 3), ``gridencoder``'s class.

    Positions in [-bound, bound]^D, shape (..., D), become ``num_levels`` times ``level_dim`` features, zeros outside.
    Differentiable in the features and, but for the borders of the cells, in the positions. Fine levels share rows of
    their tables, by the hash of the corner or, ``gridtype="tiled"``, by its number.

    Args:
        input_dim: D.
        num_levels: number of resolutions.
        level_dim: features per level.
        per_level_scale: ratio of successive resolutions, unless ``desired_resolution`` is given.
        base_resolution: resolution of the first level.
        log2_hashmap_size: binary logarithm of the largest number of rows in a table.
        desired_resolution: resolution of the last level.
        gridtype: "hash" or "tiled".
        align_corners: whether the outermost corners lie on the bounds; else half a cell outside.
        interpolation: "linear" or "smoothstep".

    Example:
        >>> encoder = GridEncoder(num_levels=4, level_dim=2, desired_resolution=64, log2_hashmap_size=10)
        >>> encoder(torch.rand(5, 3)).shape
        torch.Size([5, 8])
    """

    offsets: Tensor

    def __init__(
        self,
        input_dim: int = 3,
        num_levels: int = 16,
        level_dim: int = 2,
        per_level_scale: float = 2.0,
        base_resolution: int = 16,
        log2_hashmap_size: int = 19,
        desired_resolution: float | Tensor | None = None,
        gridtype: str = "hash",
        align_corners: bool = False,
        interpolation: str = "linear",
    ) -> None:
        super().__init__()
        if desired_resolution is not None:
            ratio = float(desired_resolution) / base_resolution
            per_level_scale = ratio ** (1 / (num_levels - 1))
        self.input_dim, self.num_levels, self.level_dim = input_dim, num_levels, level_dim
        self.per_level_scale, self.base_resolution = per_level_scale, base_resolution
        self.hashed, self.align_corners, self.smooth = gridtype == "hash", align_corners, interpolation == "smoothstep"
        self.output_dim = num_levels * level_dim
        offsets = [0]
        for level in range(num_levels):
            corners = math.ceil(base_resolution * per_level_scale**level) + (not align_corners)
            # Coarse grids have a row for every corner; finer ones share the rows of a table of this size.
            rows = min(2**log2_hashmap_size, corners**input_dim)
            offsets.append(offsets[-1] + GRANULE * math.ceil(rows / GRANULE))
        self.register_buffer("offsets", torch.tensor(offsets, dtype=torch.int32))
        self.embeddings = nn.Parameter(torch.empty(offsets[-1], level_dim).uniform_(-1e-4, 1e-4))

    def forward(self, inputs: Tensor, bound: float | Tensor = 1.0) -> Tensor:
        """Encode positions in [-bound, bound], shape (..., D)."""
        positions = ((inputs + bound) / (2 * bound)).reshape(-1, self.input_dim)
        inside = ((positions >= 0) & (positions <= 1)).all(1)
        levels = [weights @ self.embeddings[rows] for weights, rows in self._levels(positions)]
        features = torch.cat(levels, dim=2).squeeze(1) * inside[:, None]
        return features.view(*inputs.shape[:-1], self.output_dim)

    def _levels(self, positions: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Iterate over the levels: weights (B, 1, 2^D) of the corners around positions (B, D), and rows (B, 2^D)."""
        steps = torch.cartesian_prod(*[torch.arange(2, device=positions.device)] * self.input_dim)
        steps = steps.view(-1, self.input_dim)
        sizes = self.offsets.tolist()
        for level in range(self.num_levels):
            scale = self.base_resolution * self.per_level_scale**level - 1
            place = positions * scale + (0.0 if self.align_corners else 0.5)
            cell = place.detach().floor()
            part = place - cell
            if self.smooth:
                part = part * part * (3 - 2 * part)
            weights = torch.where(steps.bool(), part[:, None], 1 - part[:, None]).prod(2)
            corners = cell.long()[:, None] + steps
            first, size = sizes[level], sizes[level + 1] - sizes[level]
            yield weights[:, None], first + self._rows(corners, math.ceil(scale) + 1, size)

    def _rows(self, corners: Tensor, resolution: int, size: int) -> Tensor:
        """Return the rows of corners (..., D) in a table: their numbers, or hashes where there are too many."""
        stride, number = 1, torch.zeros_like(corners[..., 0])
        for axis in corners.unbind(-1):
            if stride > size:
                break
            number += axis * stride
            stride *= resolution + (not self.align_corners)
        if self.hashed and stride > size:
            number = torch.zeros_like(number)
            for axis, prime in zip(corners.unbind(-1), PRIMES, strict=False):
                number ^= axis * prime & WORD
        return number % size


class SHEncoder(nn.Module):
    """Evaluates the real spherical harmonics of the bands below ``degree``, 1 to 8: ``shencoder``'s class.

    Directions (..., 3), unit vectors times ``size``, become degree^2 values; differentiable.

    Convention: the Condon-Shortley phase is kept, and the order within a band is m = -l .. l.

    Raises:
        ValueError: if ``degree`` is out of range or ``input_dim`` is not 3.

    Example:
        >>> SHEncoder(degree=2)(torch.tensor([[0.0, 0.0, 1.0]])).round(decimals=3)
        tensor([[0.2820, -0.0000, 0.4890, -0.0000]])
    """

    def __init__(self, input_dim: int = 3, degree: int = 4) -> None:
        super().__init__()
        if input_dim != 3 or not 1 <= degree <= 8:
            raise ValueError(f"input_dim must be 3, and degree 1 to 8, got {input_dim} and {degree}.")
        self.input_dim, self.degree, self.output_dim = input_dim, degree, degree**2

    def forward(self, inputs: Tensor, size: float = 1.0) -> Tensor:
        """Encode directions (..., 3)."""
        x, y, z = (inputs / size).unbind(-1)
        found: dict[tuple[int, int], Tensor] = {}
        real, imaginary = torch.ones_like(x), torch.zeros_like(x)  # of (x + iy)^m
        for m in range(self.degree):
            # The associated Legendre functions without their factor (1 - z^2)^(m/2), by recursion in the band.
            before, legendre = torch.zeros_like(z), torch.full_like(z, (-1.0) ** m * math.prod(range(1, 2 * m, 2)))
            for band in range(m, self.degree):
                share = math.factorial(band - m) / math.factorial(band + m) * (1 if m == 0 else 2)
                norm = math.sqrt((2 * band + 1) / (4 * math.pi) * share)
                found[band, m], found[band, -m] = norm * legendre * real, norm * legendre * (imaginary if m else real)
                following = (z * (2 * band + 1) * legendre - (band + m) * before) / (band - m + 1)
                before, legendre = legendre, following
            real, imaginary = real * x - imaginary * y, real * y + imaginary * x
        return torch.stack([found[key] for key in sorted(found)], dim=-1)


class FreqEncoder(nn.Module):
    """Returns a vector, and sines and cosines of its multiples by 1, 2, ... 2^(degree - 1): ``freqencoder``'s class.

    Inputs (..., D) become D (1 + 2 degree) values: first themselves, then D sines and D cosines per frequency.

    Example:
        >>> FreqEncoder(input_dim=1, degree=2)(torch.zeros(1, 1)).tolist()
        [[0.0, 0.0, 1.0, 0.0, 1.0]]
    """

    def __init__(self, input_dim: int = 3, degree: int = 4) -> None:
        super().__init__()
        self.input_dim, self.degree, self.output_dim = input_dim, degree, input_dim * (1 + 2 * degree)

    def forward(self, inputs: Tensor, **kwargs: Any) -> Tensor:
        """Encode vectors (..., D)."""
        waves = [wave(inputs * 2**power) for power in range(self.degree) for wave in (torch.sin, torch.cos)]
        return torch.cat([inputs, *waves], dim=-1)
