"""gsplat's `rasterization` by the reference renderer, as gsplat 1.4 has it, which nerfstudio 1.1.5 pins."""

import torch

from reference_trainer.camera import Camera
from reference_trainer.render import render


def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, render_mode="RGB", **options):
    """gsplat 1.4: radii belong to the covariance, so a Gaussian of opacity 0 keeps its own."""
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    camera = Camera(viewmats[0].detach(), fx, fy, cx, cy, width, height)
    degree = options.get("sh_degree")
    shade = {"colors": colors} if degree is None else {"sh": colors, "sh_degree": degree}
    out = render(means, quats, scales, opacities, camera, depth=True, **shade)
    means2d = torch.zeros(1, len(means), 2, requires_grad=True)
    projected = out.splats.projection.means

    def fill(gradient):
        means2d.grad = torch.zeros_like(means2d).index_copy_(1, out.splats.indices, gradient[None])

    if projected.requires_grad:
        projected.register_hook(fill)
    channels = out.image.permute(1, 2, 0)
    if render_mode == "RGB+ED":
        channels = torch.cat([channels, (out.depth / out.alpha.clamp_min(1e-10)).unsqueeze(-1)], dim=-1)
    radii = torch.full((1, len(means)), 5, dtype=torch.int32)
    info = {"means2d": means2d, "radii": radii, "gaussian_ids": None, "width": width, "height": height, "n_cameras": 1}
    return channels[None], out.alpha[None, ..., None], info
