"""The projection against autograd Jacobians, float128-like arithmetic and numpy; spherical harmonics."""

import math

import numpy as np
import pytest
import torch
from oracles import random_scene, spherical_harmonics

from reference_trainer.camera import Camera
from reference_trainer.render import splat
from reference_trainer.render.densification import SMALLEST_SPREAD, longer_radii
from reference_trainer.render.torch.projection import evaluate_sh, project, sh_basis
from reference_trainer.rotations import rotation_matrices


def in_front(n, seed):
    scene = random_scene(n, 40, 30, seed=seed)
    camera = scene.camera
    depth = scene.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    keep = depth > 0.5
    return scene.means[keep], scene.quaternions[keep], scene.scales[keep], camera


def test_centers_follow_the_pinhole_equation_with_half_pixel_centers():
    # A point on the ray through the center of the pixel in row 7, column 3.
    camera = Camera(torch.eye(4, dtype=torch.float64), 21.0, 19.0, 5.25, 4.5, 10, 9)
    direction = torch.tensor([(3.5 - 5.25) / 21, (7.5 - 4.5) / 19, 1.0], dtype=torch.float64)
    out = project(4.2 * direction[None], torch.tensor([[1.0, 0, 0, 0]]).double(), torch.ones(1, 3).double(), camera)
    torch.testing.assert_close(out.means, torch.tensor([[3.5, 7.5]], dtype=torch.float64))
    torch.testing.assert_close(out.depths, torch.tensor([4.2], dtype=torch.float64))


def test_covariance_is_the_jacobian_sandwich():
    means, quaternions, scales, camera = in_front(30, seed=2)
    out = project(means, quaternions, scales, camera)
    axes = rotation_matrices(quaternions)
    for i in range(len(means)):
        # The Jacobian of the pixel position with respect to the world position, by autograd.
        jacobian = torch.autograd.functional.jacobian(
            lambda m, i=i: project(m[None], quaternions[i : i + 1], scales[i : i + 1], camera).means[0], means[i]
        )
        point = camera.world_to_camera[:3, :3] @ means[i] + camera.world_to_camera[:3, 3]
        inside = abs(point[0] / point[2]) < 1.3 * 20 / camera.fx and abs(point[1] / point[2]) < 1.3 * 15 / camera.fy
        if not inside:  # there the linearisation point is clamped on purpose
            continue
        covariance = axes[i] @ torch.diag(scales[i] ** 2) @ axes[i].T
        expected = jacobian @ covariance @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)
        xx, xy, yy = out.covariances[i]
        torch.testing.assert_close(torch.stack([torch.stack([xx, xy]), torch.stack([xy, yy])]), expected)


def test_factors_invert_the_covariance():
    out = project(*in_front(50, seed=3))
    xx, xy, yy = out.covariances.unbind(1)
    inverse = torch.linalg.inv(torch.stack([xx, xy, xy, yy], dim=1).view(-1, 2, 2))
    l11, l21, l22 = out.factors.unbind(1)
    factor = torch.stack([l11, l21, torch.zeros_like(l11), l22], dim=1).view(-1, 2, 2)
    torch.testing.assert_close(factor.mT @ factor, inverse, rtol=1e-10, atol=1e-12)


def test_radii_are_three_standard_deviations_of_the_longer_axis():
    out = project(*in_front(50, seed=4))
    xx, xy, yy = out.covariances.unbind(1)
    small, large = np.linalg.eigvalsh(torch.stack([xx, xy, xy, yy], dim=1).view(-1, 2, 2).numpy()).T
    # The INRIA code takes the square root of no less than 0.1, which makes round splats larger than they are.
    largest = 0.5 * (large + small) + np.sqrt(np.maximum(0.1, (0.5 * (large - small)) ** 2))
    np.testing.assert_array_equal(longer_radii(out.covariances, SMALLEST_SPREAD).numpy(), np.ceil(3 * np.sqrt(largest)))


@pytest.mark.parametrize("ratio", [1e1, 1e3, 1e5])
def test_float32_factors_of_needles_keep_their_digits(ratio):
    # A needle at 45 degrees in the image plane: xx yy - xy^2 in float32 would lose all digits at the larger ratios.
    angle = math.pi / 8
    quaternion = torch.tensor([[math.cos(angle), 0.0, 0.0, math.sin(angle)]], dtype=torch.float64)
    scales = torch.tensor([[1e-3 * ratio, 1e-3, 1e-3]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), 300.0, 300.0, 128.0, 128.0, 256, 256)
    mean = torch.tensor([[0.1, -0.05, 3.0]], dtype=torch.float64)
    exact = project(mean, quaternion, scales, camera).factors
    single = project(mean.float(), quaternion.float(), scales.float(), camera.to(dtype=torch.float32)).factors
    torch.testing.assert_close(single.double(), exact, rtol=2e-5, atol=0)


def test_quaternion_length_does_not_matter_and_rotations_are_orthonormal():
    quaternions = torch.randn(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rotations = rotation_matrices(quaternions)
    torch.testing.assert_close(rotations, rotation_matrices(7.5 * quaternions))
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(20, dtype=torch.float64))
    # wxyz: a quarter turn about z takes x to y.
    turn = rotation_matrices(torch.tensor([[1.0, 0, 0, 1.0]], dtype=torch.float64))[0]
    torch.testing.assert_close(turn @ torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.0, 1, 0]).double())


@pytest.mark.parametrize("norm", [1e-35, 1e-21, 1e-13, 1e13, 1e20, 1e37])
def test_the_norm_of_a_quaternion_does_not_matter(norm):
    # The square of 1e20 overflows float32, that of 1e-21 underflows: both had been taken for no rotation at all.
    unit = torch.tensor([[0.5, -0.5, 0.7, 0.1]], dtype=torch.float64)
    unit /= unit.norm()
    scaled = (unit * norm).float().requires_grad_()
    w, x, y, z = (scaled.detach().double() / norm)[0].tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    expected = torch.eye(3).double() + (2 * w * skew + 2 * skew @ skew) / (w * w + x * x + y * y + z * z)
    rotation = rotation_matrices(scaled)[0]
    torch.testing.assert_close(rotation.double(), expected, rtol=0, atol=1e-6)
    rotation[0, 1].backward()
    exact = unit.clone().requires_grad_()
    rotation_matrices(exact)[0, 0, 1].backward()
    torch.testing.assert_close(scaled.grad.double() * norm, exact.grad, rtol=1e-5, atol=1e-6)


def test_a_quaternion_of_zero_is_no_rotation_and_gets_no_gradient():
    zero = torch.zeros(1, 4, requires_grad=True)
    rotation = rotation_matrices(zero)
    assert torch.equal(rotation[0], torch.eye(3))
    (rotation * torch.arange(9.0).view(3, 3)).sum().backward()
    assert torch.equal(zero.grad, torch.zeros(1, 4))


def test_gradients_of_gaussians_of_a_million_scene_sizes_do_not_overflow():
    # The determinant of their covariance is 1e25 and more; its product with a variance had no float32.
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 38.0, 15.0, 12.7, 32, 24)
    g = torch.Generator().manual_seed(0)
    means = torch.rand(20, 3, generator=g) + torch.tensor([-0.5, -0.5, 2.0])
    quaternions, scales = torch.randn(20, 4, generator=g), 1e6 * (0.1 + torch.rand(20, 3, generator=g))
    weights = torch.randn(20, 3, generator=g)
    results = {}
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype, copy=True).requires_grad_() for x in (means, quaternions, scales)]
        factors = project(*leaves, camera).factors
        (factors * weights.to(dtype)).sum().backward()
        results[dtype] = [factors.detach(), *(x.grad for x in leaves)]
    for ours, exact in zip(results[torch.float32], results[torch.float64], strict=True):
        assert (ours.double() - exact).norm() < 1e-5 * exact.norm()


@pytest.mark.parametrize("kind", ["random", "needles", "huge", "quaternions"])
def test_every_engine_projects_alike(kind, case):
    """Within float32 of the float64 projection of the same rounded numbers, entry by entry."""
    scene = random_scene(200, 40, 30, seed=9)
    if kind == "needles":
        scene = scene._replace(scales=torch.tensor([[3.0, 1e-5, 1e-4]]).double().expand(200, 3))
    if kind == "huge":
        scene = scene._replace(scales=1e7 * scene.scales)
    if kind == "quaternions":
        scene = scene._replace(
            quaternions=scene.quaternions * 10.0 ** torch.arange(-20, 20).double().repeat(5)[:, None]
        )
    s = scene.to(case.dtype)
    splats = splat(*s[:4], s.camera, colors=s.colors)
    assert splats.engine.name == case.engine
    tensors = [x.double()[splats.indices] for x in s[:3]]
    exact = project(*tensors, s.camera.to(dtype=torch.float64))
    rounding = {torch.float32: 1e-4, torch.float64: 1e-11}[case.dtype]
    for mine, other in zip(splats.projection, exact, strict=True):
        scale = other.abs() if other.ndim == 1 else other.norm(dim=1, keepdim=True)
        assert (
            (mine.double() - other).abs() <= rounding * scale.clamp_min(1.0 if mine.shape[-1:] == (2,) else 0.0)
        ).all()
    depths = scene.means @ scene.camera.world_to_camera[2, :3] + scene.camera.world_to_camera[2, 3]
    assert torch.equal(splats.indices, torch.nonzero(depths > 0.2).squeeze(1))


def test_the_basis_is_scipys():
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1
    )
    torch.testing.assert_close(sh_basis(directions, 3), spherical_harmonics(directions, 3), rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_a_prefix(degree):
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    coefficients = torch.randn(5, (degree + 1) ** 2, 3, dtype=torch.float64)
    expected = torch.einsum("nk,nkc->nc", sh_basis(directions, 3)[:, : (degree + 1) ** 2], coefficients)
    torch.testing.assert_close(evaluate_sh(coefficients, directions, degree), (expected + 0.5).clamp(min=0))
