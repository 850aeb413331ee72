"""gsplat without CUDA: its true signatures on top of the reference renderer, for tests.

`rasterization` has gsplat's arguments, shapes and bookkeeping; `package` has its per-pixel functions, all but the last
of which gsplat 1.5 itself has in torch as well.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import torch

from reference_trainer.camera import Camera
from reference_trainer.render import Splats, draw
from reference_trainer.render.eager.binning import bin_gaussians
from reference_trainer.render.eager.engine import TorchEngine
from reference_trainer.render.eager.projection import project
from reference_trainer.render.eager.spherical_harmonics import evaluate_sh

MIN_ALPHA = 1 / 255


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None, render_mode="RGB",
    sparse_grad=False, absgrad=False, rasterize_mode="classic", channel_chunk=32, distributed=False,
    camera_model="pinhole",
):  # fmt: skip
    """gsplat 1.5: Gaussians below 1/255 are culled by the projection, radii are [C, N, 2] or [nnz, 2]."""
    return _rasterize(locals(), culls=True)


def rasterization_1_4(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None, render_mode="RGB",
    sparse_grad=False, absgrad=False, rasterize_mode="classic", channel_chunk=32, distributed=False,
    camera_model="pinhole",
):  # fmt: skip
    """gsplat 1.4: whatever lies in view has a radius, however faint; radii are [C, N] or [nnz]."""
    return _rasterize(locals(), culls=False)


def _rasterize(given, *, culls):
    a = SimpleNamespace(**given)
    assert (a.eps2d, a.camera_model) == (0.3, "pinhole")
    assert a.opacities.shape == a.means.shape[:1]
    cameras = [camera_of(pose, k, a.width, a.height) for pose, k in zip(a.viewmats, a.Ks, strict=True)]
    listed = [_listed(a, camera, culls) for camera in cameras]
    ids = torch.cat(listed)
    camera_ids = torch.cat([torch.full_like(x, number) for number, x in enumerate(listed)])
    parts = [project(a.means[i], a.quats[i], a.scales[i], c) for i, c in zip(listed, cameras, strict=True)]
    packed_means, depths = torch.cat([p.means for p in parts]), torch.cat([p.depths for p in parts])
    radii = torch.cat([_radii(p) for p in parts])
    radii = radii if culls else radii.amax(-1)
    if a.packed:
        means2d = packed_means
        back = means2d
    else:
        shape = (len(cameras), len(a.means))
        means2d = packed_means.new_zeros(*shape, 2).index_put((camera_ids, ids), packed_means)
        back = means2d[camera_ids, ids]
        radii = radii.new_zeros(*shape, *radii.shape[1:]).index_put((camera_ids, ids), radii)
    images, alphas = [], []
    for number, (which, part, camera) in enumerate(zip(listed, parts, cameras, strict=True)):
        projection = part._replace(means=back[camera_ids == number])
        colors = a.colors[which]
        if a.sh_degree is not None:
            directions = torch.nn.functional.normalize(a.means[which] - camera.position, dim=-1)
            colors = evaluate_sh(colors[:, : (a.sh_degree + 1) ** 2], directions, a.sh_degree)
        with torch.no_grad():
            lists = bin_gaussians(projection, a.opacities[which], a.width, a.height)
            lists = lists.only(a.opacities[which] >= MIN_ALPHA)
        out = draw(
            Splats(which, projection, a.opacities[which], colors, lists, TorchEngine()),
            background=None if a.backgrounds is None else a.backgrounds[number],
            depth="D" in a.render_mode,
        )
        channels = out.image if out.depth is None else torch.cat([out.image, out.depth[None]])
        images.append(channels.permute(1, 2, 0))
        alphas.append(out.alpha[..., None])
    info = {
        "batch_ids": torch.zeros_like(ids) if a.packed and culls else None,
        "camera_ids": camera_ids if a.packed else None,
        "gaussian_ids": ids if a.packed else None,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": torch.cat([_conics(p) for p in parts]),
        "tiles_per_gauss": (radii if radii.ndim == means2d.ndim - 1 else radii.amin(-1)).clamp(max=1),
        "width": a.width,
        "height": a.height,
        "n_cameras": len(cameras),
    }
    return torch.stack(images), torch.stack(alphas), info


def camera_of(viewmat, k, width, height):
    """The camera of a view matrix and intrinsics."""
    return Camera(viewmat, *(float(k[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))), width, height)


def intrinsics(camera):
    """The (3, 3) matrix of a camera."""
    rows = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return camera.world_to_camera.new_tensor(rows)


def centered(scene):
    """A scene in which nothing of gsplat differs from the renderer.

    The principal point is in the middle, else the projection of what lies beyond the picture's edge differs, and the
    opacities are below the clamp of every version.
    """
    middle = replace(scene.camera, cx=scene.camera.width / 2, cy=scene.camera.height / 2)
    return scene._replace(opacities=0.9 * scene.opacities, camera=middle)


def _listed(a, camera, culls):
    with torch.no_grad():
        seen = (a.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]) > max(a.near_plane, 0.2)
        if culls:
            seen = seen & (a.opacities >= MIN_ALPHA)
        which = torch.nonzero(seen).squeeze(1)
        part = project(a.means[which], a.quats[which], a.scales[which], camera)
        reach, size = _radii(part), part.means.new_tensor([a.width, a.height])
        return which[((part.means + reach > 0) & (part.means - reach < size)).all(-1)]


def _radii(projection):
    return torch.ceil(3.33 * projection.covariances.detach()[:, [0, 2]].sqrt()).int()


def _conics(projection):
    l11, l21, l22 = projection.factors.unbind(-1)
    return torch.stack([l11**2, l11 * l21, l21**2 + l22**2], dim=-1)


def package(*, max_alpha=0.999):
    """The functions that lists are made of; all but the last are the package's own torch versions (1.5)."""
    from gsplat.cuda import _torch_impl as own

    def fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, packed, calc_compensations,
        opacities,
    ):  # fmt: skip
        assert (covars, packed) == (None, False)
        covars, _ = own._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
        return own._fully_fused_projection(
            means, covars, viewmats, Ks, width, height, eps2d, near_plane, calc_compensations=calc_compensations
        )

    def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
        return own._isect_tiles(means2d, radii, depths.float(), tile_size, tile_width, tile_height)

    def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
        return own._isect_offset_encode(isect_ids, n_images, tile_width, tile_height)

    def render_clamped(opacities, **kwargs):
        colors, alphas, info = rasterization(opacities=opacities, **kwargs)
        return colors, alphas.clamp(max=max_alpha), info

    def rasterize_to_indices_in_range(
        range_start, range_end, transmittances, means2d, conics, opacities, image_width, image_height, tile_size,
        isect_offsets, flatten_ids,
    ):  # fmt: skip
        found = []
        ends = torch.cat([isect_offsets.flatten(), torch.tensor([len(flatten_ids)])]).tolist()
        columns = isect_offsets.shape[-1]
        for pixel in range(image_width * image_height):
            row, column = divmod(pixel, image_width)
            tile = row // tile_size * columns + column // tile_size
            light = float(transmittances[0, row, column])
            batch = tile_size**2
            for g in flatten_ids[ends[tile] : ends[tile + 1]][range_start * batch : range_end * batch].tolist():
                (a, b, c), (x, y) = conics[0, g].tolist(), means2d[0, g].tolist()
                dx, dy = x - column - 0.5, y - row - 0.5
                alpha = float(opacities[0, g]) * math.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                if alpha < MIN_ALPHA:
                    continue
                light *= 1 - min(alpha, max_alpha)
                if light <= 1e-4:
                    break
                found.append((g, pixel))
        ids, pixels = torch.tensor(found, dtype=torch.int64).reshape(-1, 2).unbind(1)
        return ids, pixels, torch.zeros_like(ids)

    return SimpleNamespace(
        rasterization=render_clamped,
        fully_fused_projection=fully_fused_projection,
        isect_tiles=isect_tiles,
        isect_offset_encode=isect_offset_encode,
        rasterize_to_indices_in_range=rasterize_to_indices_in_range,
        spherical_harmonics=lambda degrees_to_use, dirs, coeffs: own._spherical_harmonics(degrees_to_use, dirs, coeffs),
    )
