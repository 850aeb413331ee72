"""A rasterizer, a model and a render function with the interfaces of the INRIA family, written for the tests."""

from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import torch
from oracles import random_scene
from torch import Tensor, nn

from reference_trainer.camera import Camera
from reference_trainer.render import render as reference_render
from reference_trainer.render.constants import NEAR_PLANE
from reference_trainer.render.densification import SMALLEST_SPREAD, longer_radii
from reference_trainer.render.torch.projection import project

PIPE = SimpleNamespace(debug=False)


class Settings(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool


def make_rasterizer(form: str = "depth-alpha") -> type[nn.Module]:
    """Make a class that returns one of the tuples of the family, of which coordinates has two pictures."""

    class GaussianRasterizer(nn.Module):
        def __init__(self, raster_settings):
            super().__init__()
            self.raster_settings = raster_settings

        def forward(
            self,
            means3D,
            means2D,
            opacities,
            shs=None,
            colors_precomp=None,
            scales=None,
            rotations=None,
            cov3D_precomp=None,
        ):
            settings = self.raster_settings
            width, height = settings.image_width, settings.image_height
            camera = Camera(
                world_to_camera=settings.viewmatrix.T,
                fx=width / (2 * settings.tanfovx),
                fy=height / (2 * settings.tanfovy),
                cx=0.5 * width,
                cy=0.5 * height,
                width=width,
                height=height,
            )
            out = reference_render(
                means3D, rotations, scales, opacities, camera,
                sh=shs, colors=colors_precomp, background=settings.bg, depth=True,
            )  # fmt: skip
            centers = out.splats.projection.means
            half = centers.new_tensor([0.5 * width, 0.5 * height])
            if centers.requires_grad and means2D.requires_grad:
                indices = out.splats.indices  # a hook that held the rendering would keep its graph alive for ever

                def deliver(gradient):
                    means2D.grad = torch.zeros_like(means2D)
                    means2D.grad[indices, :2] = gradient * half

                centers.register_hook(deliver)
            radii = radii_of_all(means3D, rotations, scales, camera)
            plane = out.depth[None]
            members = {
                "plain": (),
                "inverse-depth": (plane,),
                "weights": (torch.ones(len(means3D), device=means3D.device),),
                "depth-alpha": (plane, out.alpha[None]),
                "coordinates": (plane * plane.new_tensor([1.0, 2.0, 3.0])[:, None, None],),
            }
            return (out.image, radii, *members[form])

    return GaussianRasterizer


@torch.no_grad()
def radii_of_all(means, rotations, scales, camera):
    """Radii follow from the covariances alone: a Gaussian of opacity 0 has one, as in the CUDA code."""
    radii = torch.zeros(len(means), dtype=torch.int32, device=means.device)
    front = (means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]) > NEAR_PLANE
    covariances = project(means[front], rotations[front], scales[front], camera).covariances
    radii[front] = longer_radii(covariances, SMALLEST_SPREAD).to(torch.int32)
    return radii


class Model:
    """Raw parameters and activated properties, under the names that the code bases use."""

    def __init__(self, n: int = 60, seed: int = 0, device: torch.device | str = "cpu"):
        scene = random_scene(n, 32, 24, seed).to(torch.float32, device)
        self._xyz = nn.Parameter(scene.means)
        self._scaling = nn.Parameter(scene.scales.log())
        self._rotation = nn.Parameter(scene.quaternions)
        self._opacity = nn.Parameter(torch.logit(scene.opacities)[:, None])
        self._features = nn.Parameter(scene.colors)
        self.camera = replace(scene.camera, cx=16.0, cy=12.0)  # the family's settings have no principal point

    def parameters(self):
        return [self._xyz, self._scaling, self._rotation, self._opacity, self._features]

    get_xyz = property(lambda self: self._xyz)
    get_scaling = property(lambda self: self._scaling.exp())
    get_rotation = property(lambda self: nn.functional.normalize(self._rotation))
    get_opacity = property(lambda self: self._opacity.sigmoid())
    get_features = property(lambda self: self._features)

    def update_learning_rate(self, iteration):
        return 1e-3 * 0.5**iteration


def settings_of(camera: Camera, background: Tensor) -> Settings:
    tangents = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    projection = camera.world_to_camera.new_zeros(4, 4)  # of row vectors
    for row, column, value in ((0, 0, 1 / tangents[0]), (1, 1, 1 / tangents[1]), (2, 2, 1), (2, 3, 1), (3, 2, -0.01)):
        projection[row, column] = value
    return Settings(
        image_height=camera.height,
        image_width=camera.width,
        tanfovx=tangents[0],
        tanfovy=tangents[1],
        bg=background,
        scale_modifier=1.0,
        viewmatrix=camera.world_to_camera.T,
        projmatrix=camera.world_to_camera.T @ projection,
        sh_degree=0,
        campos=torch.zeros(3, device=background.device),
        prefiltered=False,
        debug=False,
    )


def rasterize(rasterizer: type[nn.Module], model: Model, camera: Camera, background: Tensor, **replaced):
    """Call a rasterizer as the code bases do, by keywords."""
    arguments = {
        "means3D": model.get_xyz,
        "means2D": torch.zeros_like(model.get_xyz, requires_grad=True),
        "shs": None,
        "colors_precomp": model.get_features,
        "opacities": model.get_opacity,
        "scales": model.get_scaling,
        "rotations": model.get_rotation,
        "cov3D_precomp": None,
    }
    return rasterizer(raster_settings=settings_of(camera, background))(**arguments | replaced)


def make_render(rasterizer: type[nn.Module], named_alpha: bool = False):
    """Make a render function of the family; ``keep`` renders a subset by index, as the paper's code does."""

    def render(viewpoint_camera, pc, pipe, bg_color, keep=None, **replaced):
        count = len(pc.get_xyz) if keep is None else len(keep)
        points = torch.zeros(count, 3, requires_grad=True, device=pc.get_xyz.device)
        if keep is not None:
            replaced = {
                "means3D": pc.get_xyz[keep],
                "colors_precomp": pc.get_features[keep],
                "opacities": pc.get_opacity[keep],
                "scales": pc.get_scaling[keep],
                "rotations": pc.get_rotation[keep],
            }
        out = rasterize(rasterizer, pc, viewpoint_camera, bg_color, **{"means2D": points} | replaced)
        package = {
            "render": out[0],
            "viewspace_points": points,
            "visibility_filter": out[1] > 0,
            "radii": out[1],
        }
        return package | ({"rendered_alpha": out[-1]} if named_alpha else {})

    return render
