"""gsplat without CUDA: its true signatures on top of the reference renderer, for tests.

`rasterization` has gsplat's arguments, shapes and bookkeeping; `package` has its per-pixel functions, all but the last
of which gsplat 1.5 itself has in torch as well.
"""

import functools
import inspect
import math
from dataclasses import replace
from types import SimpleNamespace

import torch

from reference_trainer.compat.gsplat import make_rasterization

MIN_ALPHA = 1 / 255


def _signature(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10,
    radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None, render_mode="RGB",
    sparse_grad=False, absgrad=False, rasterize_mode="classic", channel_chunk=32, distributed=False,
    camera_model="pinhole",
):  # fmt: skip
    pass


_since_1_5, _until_1_4 = (make_rasterization(_signature, per_axis=per_axis) for per_axis in (True, False))


@functools.wraps(_signature, assigned=())
def rasterization(*args, **kwargs):
    """gsplat 1.5: Gaussians below 1/255 are culled by the projection, radii are [C, N, 2] or [nnz, 2].

    Its kernels take a background only for Gaussians that are not packed.
    """
    given = inspect.signature(_signature).bind(*args, **kwargs)
    given.apply_defaults()
    assert given.arguments["backgrounds"] is None or not given.arguments["packed"]
    images, alphas, info = _since_1_5(*args, **kwargs)
    return images, alphas, info | {"tiles_per_gauss": info["radii"].amin(-1)}


@functools.wraps(_signature, assigned=())
def rasterization_1_4(means, quats, scales, opacities, *args, **kwargs):
    """gsplat 1.4: whatever lies in view has a radius, however faint; radii are [C, N] or [nnz]."""
    images, alphas, info = _until_1_4(means, quats, scales, opacities, *args, **kwargs)
    with torch.no_grad():
        _, _, opaque = _until_1_4(means, quats, scales, torch.ones_like(opacities), *args, **kwargs)
    listed = {name: opaque[name] for name in ("radii", "gaussian_ids", "camera_ids")}
    return images, alphas, info | listed | {"batch_ids": None}


@functools.wraps(rasterization_1_4)
def rasterization_that_culls_nothing(*args, **kwargs):
    """Radii of [C, N, 2] and no culling by opacity, as `gsplat.rasterization_2dgs`."""
    image, alpha, info = rasterization_1_4(*args, **kwargs)
    info["radii"] = info["radii"][..., None].repeat_interleave(2, dim=-1)
    return image, alpha, info


@functools.wraps(rasterization_1_4)
def rasterization_without_radii(*args, **kwargs):
    """As `gsplat.rasterization_inria_wrapper`, which returns an empty dict."""
    return *rasterization_1_4(*args, **kwargs)[:2], {}


def activated(params):
    return {
        "means": params["means"],
        "quats": params["quats"],
        "scales": params["scales"].exp(),
        "opacities": params["opacities"].sigmoid(),
        "colors": params["colors"],
    }


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
