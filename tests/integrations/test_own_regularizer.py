"""A user's regularizer, the file of docs/write_your_own.md, in every hook: against literal computations."""

import math

import pytest
import torch
from oracles import random_scene
from stand_ins.gsplat import intrinsics, rasterization
from stand_ins.inria import PIPE, Model, make_render, settings_of

from ca_reg import Chain, Draw, IndependentDropout, Params, Regularizer
from ca_reg.integrations._calls import RasterizerCall, Signature, forward_signature
from ca_reg.integrations._report import Skip
from ca_reg.integrations.gsplat import regularized
from ca_reg.integrations.inria import RasterizerHook
from ca_reg.regularizer import Learned
from ca_reg.regularizers import parse
from ca_reg.schedules import LinearRamp

BLACK = torch.zeros(3)


class Move(Regularizer):
    """Changes everything that an adapter can take back."""

    needs = ("means", "scales", "quaternions", "sh")
    drops = False

    def draw(self, x, generator=None):
        return Draw()

    def replay(self, x, draw):
        changed = {name: getattr(x, name) * (2.0 + i) for i, name in enumerate(self.needs)}
        return x._replace(**changed)


class MoveMeans(Move):
    needs = ("means",)

    def replay(self, x, draw):
        return x._replace(means=x.means + 0.05)


class Concrete(Regularizer):
    learns = {"drop_logits": Learned(-1.0, 0.01)}  # noqa: RUF012


class Misspelt(IndependentDropout):
    needs = ("width",)  # gsplat has such an argument


def literal_rates(means, world_to_camera, p, reach=4.0):
    """The rates of MyDropout in Python's numbers."""
    _, _, row, _ = world_to_camera.tolist()
    depths = [sum(a * b for a, b in zip(row, [*mean, 1.0], strict=True)) for mean in means.tolist()]
    return torch.tensor([p * math.exp(-max(depth, 0.0) / reach) for depth in depths])


def test_rates_by_depth_in_the_inria_hook(rasterizer, my_module):
    model, render = Model(), make_render(rasterizer)
    pose = model.camera.world_to_camera
    rates = literal_rates(model.get_xyz, pose, 0.8)
    assert (rates - literal_rates(model.get_xyz, pose.T, 0.8)).abs().max() > 0.1  # the transposed matrix would show
    dropout = my_module.MyDropout(0.8)
    with RasterizerHook(dropout, rasterizer=rasterizer) as hook:
        hook.step(1)
        trained = render(model.camera, model, PIPE, BLACK)
        with torch.no_grad():
            tested = render(model.camera, model, PIPE, BLACK)
    keep = dropout.keep
    assert 0 < keep.sum() < len(keep)
    opacities = model.get_opacity
    expected = render(model.camera, model, PIPE, BLACK, opacities=opacities * (1 - rates)[:, None])
    torch.testing.assert_close(tested["render"], expected["render"], rtol=1e-5, atol=1e-6)
    dropped = render(model.camera, model, PIPE, BLACK, opacities=opacities * keep[:, None])
    torch.testing.assert_close(trained["render"], dropped["render"], rtol=1e-6, atol=1e-6)
    assert torch.equal(trained["radii"], dropped["radii"] * keep)
    assert (hook.tally.regularized, hook.tally.scaled) == (1, 1)


def test_its_rate_may_follow_a_schedule(rasterizer, my_module):
    model, render = Model(), make_render(rasterizer)
    with RasterizerHook(my_module.MyDropout(LinearRamp(0.0, 0.8, 0, 100)), rasterizer=rasterizer) as hook:
        for step, p in ((25, 0.2), (100, 0.8)):
            hook.step(step)
            render(model.camera, model, PIPE, BLACK)
            with torch.no_grad():
                tested = render(model.camera, model, PIPE, BLACK)
            rates = literal_rates(model.get_xyz, model.camera.world_to_camera, p)
            expected = render(model.camera, model, PIPE, BLACK, opacities=model.get_opacity * (1 - rates)[:, None])
            torch.testing.assert_close(tested["render"], expected["render"], rtol=1e-5, atol=1e-6)


def test_the_draws_of_the_hook_follow_the_rates(my_module):
    class GaussianRasterizer(torch.nn.Module):
        def __init__(self, raster_settings):
            super().__init__()
            self.raster_settings = raster_settings

        def forward(self, means3D, means2D, opacities):
            return opacities.mean().expand(3, 4, 5), torch.ones(len(means3D), dtype=torch.int32)

    model = Model()
    rates = literal_rates(model.get_xyz, model.camera.world_to_camera, 0.8).double()
    settings, steps = settings_of(model.camera, BLACK), 200
    dropped = torch.zeros(60, dtype=torch.float64)
    with RasterizerHook(my_module.MyDropout(0.8), rasterizer=GaussianRasterizer, allow_zeros=True) as hook:
        for step in range(1, steps + 1):
            hook.step(step)
            dropped += GaussianRasterizer(settings)(model.get_xyz, None, model.get_opacity)[1] == 0
    # Sum of squares of 60 normal numbers: above 130 in one run of 5 million.
    assert ((dropped - steps * rates).square() / (steps * rates * (1 - rates))).sum() < 130


def test_scales_in_the_inria_hook(rasterizer, my_module):
    model, render = Model(), make_render(rasterizer)
    noise = my_module.MyScaleNoise(0.5)
    with RasterizerHook(noise, rasterizer=rasterizer) as hook:
        hook.step(1)
        trained = render(model.camera, model, PIPE, BLACK)
        with torch.no_grad():
            tested = render(model.camera, model, PIPE, BLACK)
    larger = torch.exp(model._scaling + 0.5 * noise.last.value)
    expected = render(model.camera, model, PIPE, BLACK, scales=larger)
    torch.testing.assert_close(trained["render"], expected["render"], rtol=1e-5, atol=1e-6)
    assert torch.equal(trained["radii"], expected["radii"])
    assert torch.equal(tested["render"], render(model.camera, model, PIPE, BLACK)["render"])


def test_draws_from_a_generator_of_another_device(card, my_module):
    """As in a score, whose generator is on the processor."""
    found = []
    for device in ("cpu", card):
        x = Params(torch.full((5,), 0.5, device=device), scales=torch.ones(5, 3, device=device))
        found.append(my_module.MyScaleNoise().regularize(x, torch.Generator().manual_seed(0)).scales.cpu())
    assert torch.equal(*found)


def test_moved_positions_leave_the_gradients_on_the_screen_where_they_belong(rasterizer):
    model, render = Model(), make_render(rasterizer)
    gradients = []
    with RasterizerHook(MoveMeans(), rasterizer=rasterizer) as hook:
        hook.step(1)
        package = render(model.camera, model, PIPE, BLACK)
    for out in (package, render(model.camera, model, PIPE, BLACK, means3D=model.get_xyz + 0.05)):
        of_means = torch.autograd.grad(out["render"].square().sum(), model._xyz)[0]
        gradients.append((out["viewspace_points"].grad, of_means))
    for ours, literal in zip(*gradients, strict=True):
        assert literal.any()
        torch.testing.assert_close(ours, literal, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("split", [False, True])
def test_every_field_reaches_the_rasterizer_changed(split):
    class Plain(torch.nn.Module):
        def forward(self, means3D, means2D, opacities, shs=None, scales=None, rotations=None):
            return means3D, scales, rotations, shs

    class Split(torch.nn.Module):  # the first band apart, as in newer forks
        def forward(self, means3D, means2D, opacities, dc=None, shs=None, scales=None, rotations=None):
            return means3D, scales, rotations, torch.cat([dc, shs], 1)

    kind = Split if split else Plain
    given = {"means3D": torch.rand(5, 3), "scales": torch.rand(5, 3), "rotations": torch.rand(5, 4)}
    sh = torch.rand(5, 4, 3)
    shs = {"dc": sh[:, :1], "shs": sh[:, 1:]} if split else {"shs": sh}
    arguments = {"means2D": None, "opacities": torch.rand(5, 1), **given, **shs}
    call = RasterizerCall(kind.forward, Signature(forward_signature(kind)), [kind()], arguments)
    chain = Chain(Move())
    before = call.params(chain, 3)
    assert call._replace(before, chain(before))
    for factor, (was, now) in enumerate(zip([*given.values(), sh], call(), strict=True), start=2):
        assert torch.equal(now, was * factor)


def test_a_regularizer_of_opacities_touches_nothing_else():
    class Untouchable:
        def __getattr__(self, name):
            raise AssertionError(f"{name} was looked at")

    def forward(self, means3D, means2D, opacities, shs=None, scales=None, rotations=None):
        return opacities

    other = Untouchable()
    rasterizer = type("GaussianRasterizer", (), {"forward": forward})
    arguments = other, other, other, torch.rand(5, 1), other, other, other
    call = RasterizerCall(forward, Signature(forward_signature(rasterizer)), arguments, {})
    assert call.params(Chain(IndependentDropout()), 3)[1:] == (None,) * 6 + (3,)


@pytest.mark.parametrize(
    ("regularizer", "arguments", "message"),
    [
        (Move(), {"scales": None}, "Move needs scales, which this call .*compute_cov3D_python"),
        (Move(), {}, "Move needs sh, .*colors_precomp"),
    ],
)
def test_what_a_render_lacks_is_refused_by_name(rasterizer, regularizer, arguments, message):
    model, render = Model(), make_render(rasterizer)
    with RasterizerHook(regularizer, rasterizer=rasterizer) as hook:
        hook.step(1)
        with pytest.raises(ValueError, match=message):
            render(model.camera, model, PIPE, BLACK, **arguments)


def test_what_a_test_render_lacks_is_no_matter_to_what_leaves_it_alone(rasterizer):
    model, render = Model(), make_render(rasterizer)
    plain = {"shs": None, "colors_precomp": torch.rand(len(model.get_xyz), 3)}
    with torch.no_grad():
        expected = render(model.camera, model, PIPE, BLACK, **plain)["render"]
    with RasterizerHook(parse("sh_noise(0.5)"), rasterizer=rasterizer, patience=0) as hook, torch.no_grad():
        assert torch.equal(render(model.camera, model, PIPE, BLACK, **plain)["render"], expected)
    assert hook.tally.skipped[Skip.NOTHING_TO_SCALE] == 1


def test_what_no_render_has_is_refused_before_the_training(rasterizer):
    class Minimal(torch.nn.Module):
        def forward(self, means3D, means2D, opacities):
            raise AssertionError

    for make in (lambda x: RasterizerHook(x, rasterizer=rasterizer), lambda x: regularized(rasterization, x)):
        with pytest.raises(ValueError, match=r"Concrete .*drop_logits .*bundled trainer"):
            make(Concrete())
    with pytest.raises(ValueError, match="Misspelt needs width"):
        RasterizerHook(Misspelt(), rasterizer=rasterizer).install()
    with pytest.raises(ValueError, match=r"Move needs scales, .*means3D, means2D"):
        RasterizerHook(Move(), rasterizer=Minimal).install()
    with pytest.raises(ValueError, match=r"Misspelt needs width"):
        regularized(rasterization, Misspelt())


@pytest.fixture
def splats():
    """Gaussians and two views, as gsplat takes them; the colors are spherical harmonics of degree 1."""
    scene = random_scene(40, 24, 16, seed=3).to(torch.float32)
    poses = torch.stack([scene.camera.world_to_camera.float()] * 2)
    poses[1, 2, 3] += 3.0
    return {
        "means": scene.means,
        "quats": scene.quaternions,
        "scales": scene.scales,
        "opacities": scene.opacities.requires_grad_(),
        "colors": torch.rand(40, 4, 3, generator=torch.Generator().manual_seed(0)),
        "sh_degree": 1,
        "viewmats": poses,
        "Ks": intrinsics(scene.camera).float().expand(2, 3, 3),
        "width": 24,
        "height": 16,
        "packed": False,
    }


def test_rates_by_depth_in_the_gsplat_adapter(splats, my_module):
    rates = literal_rates(splats["means"], splats["viewmats"][0], 0.8)  # of the first camera, for both
    dropout = my_module.MyDropout(0.8)
    wrapped = regularized(rasterization, dropout)
    image, _, info = wrapped(**splats)
    keep = dropout.keep
    assert 0 < keep.sum() < 40
    torch.testing.assert_close(image, rasterization(**splats | {"opacities": splats["opacities"] * keep})[0])
    assert not info["radii"][:, ~keep].any()
    expected = rasterization(**splats | {"opacities": splats["opacities"] * (1 - rates)})[0]
    torch.testing.assert_close(wrapped.evaluate(**splats)[0], expected, rtol=1e-5, atol=1e-6)


def test_scales_and_everything_else_in_the_gsplat_adapter(splats, my_module):
    noise = my_module.MyScaleNoise(0.5)
    image = regularized(rasterization, noise)(**splats)[0]
    larger = splats["scales"] * torch.exp(0.5 * noise.last.value)
    torch.testing.assert_close(image, rasterization(**splats | {"scales": larger})[0], rtol=1e-5, atol=1e-6)
    changed = {name: splats[name] * (2.0 + i) for i, name in enumerate(("means", "scales", "quats", "colors"))}
    image = regularized(rasterization, Move())(**splats)[0]
    assert torch.equal(image, rasterization(**splats | changed)[0])


def test_what_a_call_of_gsplat_lacks_is_refused_by_name(splats):
    wrapped = regularized(rasterization, Move())
    colors = splats["colors"]
    for changes in ({"sh_degree": None, "colors": colors[:, 0]}, {"colors": colors.expand(2, -1, -1, -1)}):
        with pytest.raises(ValueError, match=r"Move needs sh, .*sh_degree"):
            wrapped(**splats | changes)

    def with_covars(means, quats, scales, opacities, colors, viewmats, Ks, width, height, covars=None, **options):
        raise AssertionError

    with pytest.raises(ValueError, match=r"needs scales, .*covars"):
        regularized(with_covars, Move())(**splats | {"covars": torch.rand(40, 3, 3)})
