"""Everything that the package computes from a small scene, in a chosen precision, and the reference for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ca_reg import CAScore
from ca_reg.functional import Multiplier, apply_dropout, apply_opacity_noise, draw_keep_mask, draw_opacity_noise
from reference_trainer.camera import Camera
from reference_trainer.render import Splats, rasterize, splat
from reference_trainer.render.renderer import render_moments

__all__ = [
    "IMAGES", "PARAMETERS", "RATE", "SCENE_QUANTITIES", "Quantities", "StressScene", "base_scene", "camera_of",
    "independent_images", "loss_weights", "reference_quantities", "render_simply", "scene_quantities", "splats_of",
    "stack",
]  # fmt: skip

PARAMETERS = ("means", "quaternions", "scales", "opacities", "colors")
"""Names of the Gaussians' tensors, in the order of the renderer's arguments."""

_SCENE_SEED = 20
_DISTANCE = 3.0  # from the camera to the center of the scene, whose half width is 1


@dataclass(frozen=True)
class StressScene:
    """Gaussians, a camera and a background."""

    means: Tensor  # world coordinates, shape (N, 3)
    quaternions: Tensor  # wxyz, shape (N, 4)
    scales: Tensor  # standard deviations, shape (N, 3)
    opacities: Tensor  # activated, shape (N,)
    colors: Tensor  # RGB, shape (N, 3)
    background: Tensor  # shape (3,)
    camera: Camera  # the view

    @property
    def parameters(self) -> list[Tensor]:
        """The Gaussians' tensors, by `PARAMETERS`."""
        return [getattr(self, name) for name in PARAMETERS]

    def to(self, dtype: torch.dtype, *, camera: torch.dtype | None = None) -> StressScene:
        """Return the scene in another dtype; ``camera`` is that of the camera's pose, if it differs."""
        tensors = {x.name: getattr(self, x.name).to(dtype) for x in fields(self) if x.name != "camera"}
        return StressScene(**tensors, camera=self.camera.to(dtype=camera or dtype))

    def rounded(self, dtype: torch.dtype = torch.float32) -> StressScene:
        """Return the scene in float64, with all but the pose rounded to a dtype."""
        return self.to(dtype, camera=torch.float64).to(torch.float64)


def camera_of(width: int = 32, height: int = 24, *, focal: float = 40.0, distance: float = _DISTANCE) -> Camera:
    """Return a rotated camera at a distance from the origin, which lies on its optical axis; float64."""
    skew = torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.3], [-0.2, 0.3, 0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(skew)
    pose[2, 3] = distance
    return Camera(pose, focal, 0.95 * focal, 0.47 * width, 0.53 * height, width, height)


def base_scene(n: int = 24, *, camera: Camera | None = None) -> StressScene:
    """Draw n ordinary Gaussians around the origin, float64; by default 32 x 24 pixels from a distance of 3.

    Example:
        >>> base_scene(5).means.shape
        torch.Size([5, 3])
    """
    generator = torch.Generator().manual_seed(_SCENE_SEED)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    return StressScene(
        means=uniform(-0.8, 0.8, n, 3),
        quaternions=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        scales=0.15 * torch.exp(uniform(-0.7, 0.7, n, 3)),
        opacities=uniform(0.2, 0.9, n),
        colors=uniform(0.0, 1.0, n, 3),
        background=torch.tensor([0.1, 0.3, 0.2], dtype=torch.float64),
        camera=camera or camera_of(),
    )


def stack(n: int, opacity: float, *, spacing: float = 1e-3) -> StressScene:
    """Put n Gaussians one behind the other on the optical axis of an 8 x 8 camera: all of them reach all pixels."""
    scene = base_scene(n, camera=Camera(torch.eye(4, dtype=torch.float64), 20.0, 20.0, 4.0, 4.0, 8, 8))
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = 2.0 + spacing * torch.arange(n, dtype=torch.float64)
    opacities = torch.full((n,), opacity, dtype=torch.float64)
    return replace(scene, means=means, scales=scene.scales + 0.5, opacities=opacities)


_NEAR, _DILATION, _MARGIN = 0.2, 0.3, 1.3
_MAX_ALPHA, _MIN_ALPHA, _MIN_LIGHT = 0.99, 1 / 255, 1e-4
_TILE = 16


def render_simply(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, camera: Camera
) -> Tensor:
    """Render Gaussians over black by the textbook formulas, tile by tile, with autograd's own backward pass: (3, H, W).

    A tile of 16 x 16 pixels considers every Gaussian whose bounding box at alpha = 1/255 overlaps it, so nothing that
    the definition renders is left out: in float64 the result is that of brute force. All pixel-Gaussian pairs are kept
    for the backward pass.

    Convention: OpenCV camera, half-pixel centers, wxyz quaternions of any norm; the constants of the INRIA rasterizer;
    the gradient passes through the clamp at 0.99.

    Example:
        >>> camera = Camera(torch.eye(4), 50.0, 50.0, 8.5, 8.5, 16, 16)
        >>> image = render_simply(torch.tensor([[0.0, 0, 1]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),
        ...                       torch.tensor([0.8]), torch.tensor([[1.0, 0.5, 0]]), camera)
        >>> [round(x, 3) for x in image[:, 8, 8].tolist()]
        [0.8, 0.4, 0.0]
    """
    view = camera.world_to_camera.to(means)
    depths = (means @ view[:3, :3].T + view[:3, 3])[:, 2].detach()
    order = torch.argsort(depths, stable=True)
    order = order[depths[order] > _NEAR]
    centers, covariances = _project(means[order], quaternions[order], scales[order], view, camera)
    opacities, colors = opacities[order], colors[order]
    inverses = torch.linalg.inv(covariances)
    with torch.no_grad():
        radii = torch.sqrt(2 * torch.log(opacities / _MIN_ALPHA).clamp(min=0))
        reach = radii[:, None] * covariances.diagonal(dim1=1, dim2=2).sqrt()
        low, high = centers - reach, centers + reach
    strips = []
    for top in range(0, camera.height, _TILE):
        strip = []
        for left in range(0, camera.width, _TILE):
            right, bottom = min(left + _TILE, camera.width), min(top + _TILE, camera.height)
            begin, end = means.new_tensor([left, top]), means.new_tensor([right, bottom])
            near = torch.nonzero(((high >= begin) & (low <= end)).all(dim=1)).squeeze(1)
            y, x = torch.meshgrid(
                torch.arange(top, bottom).to(means) + 0.5, torch.arange(left, right).to(means) + 0.5, indexing="ij"
            )
            pixels = torch.stack([x, y], dim=-1).view(-1, 2)
            sums = _blend(pixels, centers[near], inverses[near], opacities[near], colors[near])
            strip.append(sums.T.view(-1, bottom - top, right - left))
        strips.append(torch.cat(strip, dim=2))
    return torch.cat(strips, dim=1)


def _project(means: Tensor, quaternions: Tensor, scales: Tensor, view: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the projected means (M, 2) and the dilated covariances (M, 2, 2)."""
    rotation = view[:3, :3]
    x, y, z = (means @ rotation.T + view[:3, 3]).unbind(1)
    limit_x, limit_y = _MARGIN * camera.width / (2 * camera.fx), _MARGIN * camera.height / (2 * camera.fy)
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], dim=1)
    a, b, c, d = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    orientation = torch.stack(
        [
            a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c),
            2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b),
            2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d,
        ], dim=1,
    ).view(-1, 3, 3)  # fmt: skip
    half = jacobian.view(-1, 2, 3) @ rotation @ (orientation * scales[:, None, :])
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    return centers, half @ half.transpose(1, 2) + _DILATION * torch.eye(2).to(means)


def _blend(pixels: Tensor, centers: Tensor, inverses: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
    """Composite Gaussians, nearest first, at pixels (P, 2); return colors (P, C)."""
    dx, dy = (pixels[:, None] - centers).unbind(2)
    power = inverses[:, 0, 0] * dx * dx + 2 * inverses[:, 0, 1] * dx * dy + inverses[:, 1, 1] * dy * dy
    raw = opacities * torch.exp(-0.5 * power)
    alpha = raw + (raw.clamp(max=_MAX_ALPHA) - raw).detach()
    alpha = torch.where(raw >= _MIN_ALPHA, alpha, 0.0)
    remaining = torch.cumprod(1 - alpha, dim=1)
    weights = torch.where(remaining >= _MIN_LIGHT, alpha * remaining / (1 - alpha), 0.0)
    return weights @ colors


Quantities = Mapping[str, Tensor]

_GRADIENTS = tuple(f"d {name}" for name in PARAMETERS)
IMAGES = ("image", "alpha", *_GRADIENTS)
SCENE_QUANTITIES = (*IMAGES, "mean", "variance", "d variance", "CA", "dropout", "noise")

RATE = 0.3
"""Rate of dropout, unless a case sets another."""
_SIGMA, _SEED = 0.5, 7


def scene_quantities(
    scene: StressScene, dtype: torch.dtype, *, rate: float = RATE, sigma: float = _SIGMA, keep: Tensor | None = None
) -> Quantities:
    """Compute `SCENE_QUANTITIES`: image, gradients, exact moments, score, and renders under a draw of dropout or noise.

    ``dtype`` is that of the Gaussians; the pose stays in float64, as a careful caller would keep it. ``rate`` is that
    of dropout, in the draw, the moments and the score, ``sigma`` that of the opacity noise, ``keep`` (N,) the dropout
    mask, drawn by default.
    """
    scene = scene.to(dtype, camera=torch.float64)
    n = scene.means.shape[0]
    leaves = _leaves(scene)
    out = rasterize(splats_of(leaves), background=scene.background)
    result = {"image": out.image.detach(), "alpha": out.alpha.detach()}
    result |= _gradients(_loss(out.image, out.alpha, scene.camera), leaves.parameters, _GRADIENTS)

    multiplier = Multiplier.dropout(rate)
    leaves = _leaves(scene)
    moments = render_moments(splats_of(leaves), multiplier, background=scene.background)
    result |= {"mean": moments.mean.detach(), "variance": moments.variance.detach()}
    loss = _loss(moments.variance, moments.alpha_mean, scene.camera)
    result |= _gradients(loss, [leaves.means], ["d variance"])

    def exact(opacity: Tensor, view: None, multiplier: Multiplier, background: Tensor | None) -> object:
        background = scene.background if background is None else background
        return render_moments(splats_of(replace(scene, opacities=opacity)), multiplier, background=background)

    score = CAScore.exact(exact, drop_rate=rate, threshold=0.5)(scene.opacities, None)
    result["CA"] = torch.tensor([score.value], dtype=torch.float64)

    if keep is None:
        keep = draw_keep_mask(n, rate, generator=torch.Generator().manual_seed(_SEED))
    noise = draw_opacity_noise(n, sigma, generator=torch.Generator().manual_seed(_SEED))
    drawn = {"dropout": apply_dropout(scene.opacities, keep), "noise": apply_opacity_noise(scene.opacities, noise)}
    for name, opacities in drawn.items():
        result[name] = rasterize(splats_of(replace(scene, opacities=opacities)), background=scene.background).image
    return result


def reference_quantities(scene: StressScene, *, rate: float = RATE) -> Quantities:
    """Compute the same in float64, with image, alpha and gradients by the independent renderer `render_simply`.

    Moments, score and draws are those of the package's renderer in float64.
    """
    return {**scene_quantities(scene, torch.float64, rate=rate), **independent_images(scene)}


def independent_images(scene: StressScene) -> Quantities:
    """Compute `IMAGES` in float64 with `render_simply`; a fourth color channel of ones gives alpha."""
    scene = _leaves(scene.to(torch.float64))
    means, quaternions, scales, opacities, colors = scene.parameters
    columns = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    sums = render_simply(means, quaternions, scales, opacities, columns, scene.camera)
    image, alpha = sums[:3] + (1 - sums[3]) * scene.background[:, None, None], sums[3]
    result = {"image": image.detach(), "alpha": alpha.detach()}
    return result | _gradients(_loss(image, alpha, scene.camera), scene.parameters, _GRADIENTS)


def loss_weights(camera: Camera) -> Tensor:
    """Return the weights of red, green, blue and alpha in the loss: random, so that nothing cancels by symmetry.

    They are multiples of 1/64, exact in every precision, (4, H, W), float64.
    """
    generator = torch.Generator().manual_seed(_SEED)
    return torch.randint(-20, 45, (4, camera.height, camera.width), generator=generator).double() / 64


def splats_of(scene: StressScene) -> Splats:
    """Project the Gaussians of a scene."""
    return splat(scene.means, scene.quaternions, scene.scales, scene.opacities, scene.camera, colors=scene.colors)


def _leaves(scene: StressScene) -> StressScene:
    """Return the scene with copies of its parameters that require gradients."""
    return replace(scene, **{name: getattr(scene, name).clone().requires_grad_() for name in PARAMETERS})


def _loss(image: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    weights = loss_weights(camera).to(alpha)
    return (image * weights[:3]).sum() + (alpha * weights[3]).sum()


def _gradients(loss: Tensor, leaves: Sequence[Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Return the gradients of a loss by name, 0 for what it does not depend on."""
    if not loss.requires_grad:
        return dict(zip(names, map(torch.zeros_like, leaves), strict=True))
    with torch.autocast("cpu", enabled=False):  # as PyTorch recommends for backward passes
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True)
    return dict(zip(names, gradients, strict=True))
