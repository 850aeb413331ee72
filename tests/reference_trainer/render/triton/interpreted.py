"""The kernels against the torch engine and against brute force, in Triton's interpreter or, without it, on a card.

Run by `test_interpreted.py` and, on a card, by `test_on_a_card.py`, in a process of its own: whether Triton interprets
is decided when it is imported. By hand: ``TRITON_INTERPRET=1 pytest -n0 -m "" FILE``.
"""

import itertools
import os
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from oracles import GaussianScene, brute_force, random_scene
from torch import Tensor

from ca_reg.functional import Multiplier
from reference_trainer.camera import Camera
from reference_trainer.evaluation import shares as shares_module
from reference_trainer.render import rasterize, render_masks, render_moments, splat, use_engine, variance_shares
from reference_trainer.render.constants import MIN_ALPHA, MIN_TRANSMITTANCE, TILE
from reference_trainer.render.densification import absgrad_sink, splat_weights, with_absolute_gradients
from reference_trainer.runs.run import model_of
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.virtual_cameras import unseen_views
from reference_trainer.studies.stability.cases import all_cases
from reference_trainer.studies.stability.stability_study import judge
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

DEVICE = torch.device("cpu" if os.environ.get("TRITON_INTERPRET") == "1" else "cuda")
# What differs between a processor and a card is the rounding of division, square roots and exponentials.
IMAGE, GRADIENT = (2e-6, 1e-5) if DEVICE.type == "cpu" else (2e-5, 2e-4)
BACKGROUND = torch.tensor([0.2, 0.4, 0.6])

if DEVICE.type == "cpu":
    import triton.runtime.interpreter as interpreter

    patched, run = set(), interpreter.GridExecutor.__call__

    def run_afresh(self, *args, **kwargs):
        patched.clear()
        return run(self, *args, **kwargs)

    def call_once_patched(self, *args, **kwargs):
        """The interpreter patches the language at every call of a helper: once per launch takes half the time."""
        if id(self.fn.__globals__) not in patched:
            interpreter._patch_lang(self.fn)
            patched.add(id(self.fn.__globals__))
        return self.rewrite()(*args, **kwargs)

    interpreter.GridExecutor.__call__ = run_afresh
    interpreter.InterpretedFunction.__call__ = call_once_patched


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    monkeypatch.setenv("CA_REG_ENGINE", "auto")


def scene(n=20, width=19, height=13, seed=2, **options):
    return random_scene(n, width, height, seed, **options)


def stack(n, opacity):
    """Gaussians one behind the other, in one tile: more than are read or restored at once."""
    s = random_scene(n, 8, 8, seed=4, size=0.3)
    means = 0.2 * s.means
    means[:, 2] = torch.linspace(-1, 1, n, dtype=torch.float64)
    return s._replace(means=means, opacities=torch.full_like(s.opacities, opacity))


def shaped(**axes):
    """Scales along the axes, times the usual ones."""
    s = scene(12, 16, 16, seed=5)
    return s._replace(scales=s.scales * torch.tensor([axes.get(x, 1.0) for x in "xyz"], dtype=torch.float64))


def quaternions_times(factor):
    s = scene(8, 16, 8, seed=6)
    return s._replace(quaternions=s.quaternions * factor)


def one_plane():
    """Equal depths: the order is that of the numbers."""
    s = scene(12, 16, 8, seed=7, size=0.2)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 2.0
    s.means[:, 2] = 0
    return s._replace(camera=Camera(pose, 20.0, 20.0, 8.0, 4.0, 16, 8))


def beside():
    """Beyond the border where the linearization is clipped, and wide enough to be seen."""
    s = scene(8, 16, 16, seed=8, size=0.5)
    return s._replace(means=s.means + torch.tensor([2.5, 0.0, 0.0], dtype=torch.float64))


SCENES = {
    "random": scene,
    "one pixel": lambda: scene(10, 1, 1, seed=3, size=0.4),
    "one Gaussian": lambda: stack(1, 0.7),
    "nothing in view": lambda: scene(4)._replace(means=torch.full((4, 3), -9.0, dtype=torch.float64)),
    "no Gaussian": lambda: GaussianScene(*(x[:0] for x in scene(4).tensors()), scene(4).camera),
    "a thick stack": lambda: stack(50, 0.3),
    "an opaque stack": lambda: stack(40, 0.97),
    "alphas at the clamp": lambda: stack(4, 1.0),
    "needles": lambda: shaped(x=20.0, y=1e-3, z=1e-3),
    "pancakes": lambda: shaped(x=10.0, y=10.0, z=1e-4),
    "giants": lambda: shaped(x=300.0, y=300.0, z=300.0),
    "specks": lambda: shaped(x=1e-6, y=1e-6, z=1e-6),
    "long quaternions": lambda: quaternions_times(1e18),
    "short quaternions": lambda: quaternions_times(1e-18),
    "no rotation": lambda: quaternions_times(0.0),
    "one plane": one_plane,
    "beside the image": beside,
}
QUICK = ("one pixel",)
every_scene = pytest.mark.parametrize(
    "name", [pytest.param(x, marks=() if x in QUICK else pytest.mark.slow) for x in SCENES]
)


class Outcome(NamedTuple):
    """What one engine makes of a scene, on the processor."""

    images: list[Tensor]
    gradients: list[Tensor]


def safe_pixels(s):
    """Pixels, (H, W), at which no alpha and no transmittance is within rounding of a threshold: elsewhere, two correct
    programs may differ by a step of 1/255."""
    use_engine("torch")
    splats = splat(*s[:4], s.camera, colors=s.colors)
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in (s.camera.height, s.camera.width)), indexing="ij")
    order = torch.argsort(splats.projection.depths, stable=True)
    dx, dy = (axis[..., None] - splats.projection.means[order, i] for i, axis in enumerate((x, y)))
    l11, l21, l22 = splats.projection.factors[order].unbind(1)
    raw = splats.opacities[order] * torch.exp(-0.5 * ((l11 * dx + l21 * dy) ** 2 + (l22 * dy) ** 2))
    alpha = torch.where(raw >= MIN_ALPHA, raw.clamp(max=0.99), 0.0)
    left = (1 - alpha).cumprod(-1)
    near = ((raw / MIN_ALPHA - 1).abs() < 1e-3) | ((left / MIN_TRANSMITTANCE - 1).abs() < 1e-2)
    return ~near.any(-1)


def weights(channels, s):
    """Random gradients of images, 0 where a comparison means nothing."""
    safe = safe_pixels(s)
    assert safe.double().mean() > 0.5 or safe.numel() < 10
    g = torch.Generator().manual_seed(1)
    return torch.randn(channels, *safe.shape, generator=g) * safe


def leaves_of(engine, *tensors):
    """The inputs of an engine: float32 for "triton" and "torch", the same numbers in float64 for "exact"."""
    use_engine("torch" if engine == "exact" else engine)
    device = DEVICE if engine == "triton" else torch.device("cpu")
    dtype = torch.float64 if engine == "exact" else torch.float32
    return [x.detach().to(device, torch.float32).to(dtype).clone().requires_grad_() for x in tensors]


def outcome(engine, s, w, render):
    """Images (C, H, W) of a function of splats and a background, and the gradients of all inputs."""
    *leaves, background = leaves_of(engine, *s.tensors(), BACKGROUND)
    splats = splat(*leaves[:4], s.camera, colors=leaves[4])
    assert splats.engine.name == ("triton" if engine == "triton" else "torch")
    images, more = render(splats, background)
    stacked = torch.cat([x.reshape(-1, *w.shape[1:]) for x in images])
    (stacked * w.to(stacked)).sum().backward()
    return Outcome([stacked.detach().cpu()], [x.grad.cpu() for x in (*leaves, background, *more)])


def close(mine, theirs, exact, tolerance):
    """Within the tolerance of the largest, or as exact as the other engine, which rounds in another order."""
    if exact.numel() == 0:
        return
    largest, error = exact.abs().max(), (mine - exact).abs().max()
    assert error <= max(tolerance * largest, 4 * (theirs - exact).abs().max()) + 1e-12, (error, largest)


def same(made, w, *, gradient=GRADIENT):
    """Assert that the kernels' outcome is that of the torch engine, of which one in float64 tells what is right."""
    mine, theirs, exact = (made(engine) for engine in ("triton", "torch", "exact"))
    for images in zip(mine.images, theirs.images, exact.images, strict=True):
        close(*(torch.cat([torch.ones(1), (x * (w[0] != 0)).flatten()]) for x in images), IMAGE)
    for gradients in zip(mine.gradients, theirs.gradients, exact.gradients, strict=True):
        close(*gradients, gradient)


def plain(splats, background):
    out = rasterize(splats, background=background, depth=True)
    return (out.image, out.alpha, out.depth), ()


def random_moments(splats, background):
    """With other moments of the factor for every Gaussian, and another background for every pixel."""
    g, size = torch.Generator().manual_seed(5), (splats.lists.height, splats.lists.width)
    n = 1 + int(splats.indices.max()) if len(splats.indices) else 0
    each = torch.rand(2, 64, generator=g)[:, : max(n, 1)].to(background).requires_grad_()
    behind = torch.rand(3, *size, generator=g).to(background).requires_grad_()
    everywhere = background[:, None, None] * behind
    return render_moments(splats, Multiplier(each[0], each[1]), background=everywhere), (behind, each)


@every_scene
def test_images_alpha_depth_and_all_gradients(name):
    s = SCENES[name]()
    w = weights(5, s)
    # Walking front to back, the light behind a splat is a difference, which is divided by 1 - alpha: 0.03 there.
    same(lambda engine: outcome(engine, s, w, plain), w, gradient=GRADIENT * (4 if name == "an opaque stack" else 1))


@every_scene
def test_moments_and_all_gradients(name):
    s = SCENES[name]()
    w = weights(7, s)
    same(lambda engine: outcome(engine, s, w, random_moments), w)


@pytest.mark.parametrize("n", [pytest.param(6, id="few"), pytest.param(30, marks=pytest.mark.slow)])
def test_images_are_those_of_brute_force(n):
    s = scene(n, 16, 9, seed=1, size=0.15)
    safe = safe_pixels(s)
    image, alpha = brute_force(*s.tensors(), s.camera)
    leaves = leaves_of("triton", *s.tensors())
    out = rasterize(splat(*leaves[:4], s.camera, colors=leaves[4]))
    for mine, exact in ((out.image, image), (out.alpha, alpha)):
        assert ((mine.detach().cpu() - exact) * safe).abs().max() <= 2e-5  # float32 coordinates against float64


def six(engine):
    """Six Gaussians and a background as an engine takes them, with a camera that float32 represents exactly."""
    s = scene(6, 12, 8, seed=1, size=0.2).to(torch.float32).to(torch.float64)
    *leaves, background = leaves_of(engine, *s.tensors(), BACKGROUND)
    return s._replace(**dict(zip(s._fields, leaves, strict=False))), background


def over_all_masks(s, background):
    """Probabilities of the 64 masks given a rate, and brute force's pictures: RGB and alpha, (64, 4, H, W)."""
    masks = torch.tensor([*itertools.product([0.0, 1.0], repeat=6)], dtype=torch.float64)
    pictures = []
    for mask in masks:
        sums, alpha = brute_force(*s[:3], s.opacities * mask, s.colors, s.camera)
        pictures.append(torch.cat([sums + (1 - alpha) * background[:, None, None], alpha[None]]))
    assert pictures[-1][3].max() < 0.999  # moments know no early stop
    return (
        masks,
        lambda rate: (masks * (1 - rate) + (1 - masks) * rate).prod(1)[:, None, None, None],
        torch.stack(pictures),
    )


def as_issued(mine, exact):
    """Within the goals: of pictures, and of gradients as a share of the largest."""
    for name, (a, b) in {"picture": (mine.images, exact.images), "gradient": (mine.gradients, exact.gradients)}.items():
        for x, y in zip(a, b, strict=True):
            scale, tolerance = (max(1.0, y.abs().max()), IMAGE) if name == "picture" else (y.abs().max(), GRADIENT)
            assert (x - y).abs().max() <= tolerance * scale, (name, (x - y).abs().max() / scale)


@pytest.mark.slow
def test_pictures_depth_and_gradients_of_six_are_those_of_brute_force():
    s, background = six("exact")
    w = weights(5, s)
    depth = (s.means @ s.camera.world_to_camera[2, :3] + s.camera.world_to_camera[2, 3])[:, None]
    sums, alpha = brute_force(*s[:4], torch.cat([s.colors, depth], 1), s.camera)
    images = torch.cat([sums[:3] + (1 - alpha) * background[:, None, None], alpha[None], sums[3:]])
    (images * w).sum().backward()
    exact = Outcome([(images * (w != 0)).detach()], [x.grad for x in (*s.tensors(), background)])
    mine = outcome("triton", s, w, plain)
    as_issued(mine._replace(images=[mine.images[0] * (w != 0)]), exact)


@pytest.mark.slow
def test_moments_masks_and_shares_of_six_are_those_of_all_64_masks():
    s, background = six("exact")
    w = weights(7, s)
    rate = torch.linspace(0.1, 0.7, 6, dtype=torch.float64, requires_grad=True)
    masks, chance, pictures = over_all_masks(s, background)
    mean = (chance(rate) * pictures).sum(0)
    variance = (chance(rate) * (pictures - mean).square()).sum(0)[:3]
    images = torch.cat([mean[:3], variance, mean[3:]])
    (images * w).sum().backward()
    exact = Outcome([(images * (w != 0)).detach()], [x.grad for x in (*s.tensors(), background, rate)])

    def render(splats, background):
        p = rate.detach().to(background).requires_grad_()
        found = render_moments(splats, Multiplier(1 - p, p * (1 - p)), background=background)
        return found, (p,)

    mine = outcome("triton", s, w, render)
    as_issued(mine._replace(images=[mine.images[0] * (w != 0)]), exact)

    drawn, behind = six("triton")
    with torch.no_grad():
        splats = splat(*drawn[:4], s.camera, colors=drawn[4])
        some = masks[::9].to(drawn.opacities)
        colors, alphas = render_masks(splats, some * drawn.opacities, background=behind)
        found = torch.cat([colors, alphas[:, None]], 1).cpu()
        assert ((found - pictures[::9]) * (w[0] != 0)).abs().max() <= IMAGE
        p, safe = rate.to(behind), (w[0] != 0).to(behind)
        shares = variance_shares(splats, Multiplier(1 - p, p * (1 - p)), safe, background=behind)
        # The share of one is the variance of the mean, given who is in front, that it adds to the mean without it.
        order = (s.means @ s.camera.world_to_camera[2, :3]).argsort().tolist()
        given = pictures[:, :3].reshape(*[2] * 6, 3, *safe.shape).permute(*order, 6, 7, 8)
        for k, i in reversed([*enumerate(order)]):
            dropped, kept = given.unbind(k)
            share = rate[i] * (1 - rate[i]) * (kept - dropped).square()
            given = rate[i] * dropped + (1 - rate[i]) * kept
            for j in order[:k]:
                share = rate[j] * share[0] + (1 - rate[j]) * share[1]
            at = (splats.indices == i).nonzero()[:, 0]
            assert abs(shares[at].sum() - (share.mean(0) * safe.cpu()).sum()) <= GRADIENT * shares.max()


# Of the stability study, what pushes the geometry; the interpreter, which takes seconds, has every sixth.
EXTREMES = {
    f"{case.family}: {case.name}": number
    for number, case in enumerate(all_cases())
    if case.family in ("shape and size", "place", "camera and image") and "4096" not in case.name
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(EXTREMES)[:: 6 if DEVICE.type == "cpu" else 1])
def test_the_far_end_of_the_stability_study(name):
    case = all_cases()[EXTREMES[name]]
    far = max(x for x in case.magnitudes if x <= case.until)
    use_engine("triton")
    record = judge(replace(case, magnitudes=(far,)))
    assert record["ending"] == "ok", record["points"]


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics(degree):
    """With more coefficients than the degree uses."""
    s = scene(12, 11, 9, seed=9, size=0.3)
    sh = torch.randn(12, 16, 3, generator=torch.Generator().manual_seed(3))
    w = weights(3, s)

    def made(engine):
        leaves = leaves_of(engine, *s[:4], sh)
        splats = splat(*leaves[:4], s.camera, sh=leaves[4], sh_degree=degree)
        image = rasterize(splats).image
        (image * w.to(image)).sum().backward()
        assert (leaves[4].grad[:, (degree + 1) ** 2 :] == 0).all()
        return Outcome([image.detach().cpu()], [x.grad.cpu() for x in leaves])

    same(made, w)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4, 5])
def test_pictures_of_many_masks(count):
    s = scene(16, 17, 9, seed=3, size=0.2)
    keep = (torch.rand(count, 16, generator=torch.Generator().manual_seed(1)) > 0.4).double()
    lower = s.opacities * keep * torch.rand(count, 16, generator=torch.Generator().manual_seed(2)).double()
    lower[0] = 0  # a picture of nothing
    safe = torch.stack([safe_pixels(s._replace(opacities=row)) for row in lower]).all(0)

    def made(engine):
        leaves = [x.detach() for x in leaves_of(engine, *s.tensors(), lower, BACKGROUND)]
        splats = splat(*leaves[:4], s.camera, colors=leaves[4])
        one = rasterize(splats.engine.masked(splats, leaves[5][-1][splats.indices]), background=leaves[6])
        return [x.cpu() for x in (*render_masks(splats, leaves[5], background=leaves[6]), one.image, one.alpha)]

    mine = made("triton")
    for a, b in zip(mine, made("torch"), strict=True):
        assert ((a - b) * safe).abs().max() <= IMAGE
    assert torch.equal(mine[0][0], BACKGROUND[:, None, None].expand_as(mine[0][0]))


@pytest.mark.slow
def test_absolute_gradients_and_weights():
    s = scene(14, 17, 9, seed=5, size=0.2)
    w = weights(5, s)

    def made(engine):
        leaves = leaves_of(engine, *s.tensors())
        splats = splat(*leaves[:4], s.camera, colors=leaves[4])
        sink = absgrad_sink(splats.projection.means)
        out = with_absolute_gradients(rasterize(splats, depth=True), sink)
        images = torch.cat([out.image, out.alpha[None], out.depth[None]])
        (images * w.to(images)).sum().backward()
        return Outcome([], [splats.projection.means.absgrad.cpu(), splat_weights(splats).cpu()])

    same(made, w)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random", "a thick stack"])
def test_shares(name):
    s = SCENES[name]()
    w = weights(1, s)[0].abs()

    def made(engine):
        leaves = [x.detach() for x in leaves_of(engine, *s.tensors(), w)]
        splats = splat(*leaves[:4], s.camera, colors=leaves[4])
        found = variance_shares(splats, Multiplier.dropout(0.5), leaves[5])
        total = (render_moments(splats, Multiplier.dropout(0.5)).variance.mean(0) * leaves[5]).sum()
        assert abs(found.sum() / total - 1) < 1e-5
        return Outcome([], [found.cpu()])

    same(made, w[None])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random", "needles", "giants", "one plane", "beside the image"])
def test_lists_hold_what_can_be_seen_nearest_first(name):
    """Those of the torch engine, but for entries that nowhere reach 1/255 by more than rounding."""
    s = SCENES[name]()
    pairs = []
    for engine in ("triton", "torch"):
        leaves = [x.detach() for x in leaves_of(engine, *s.tensors())]
        splats = splat(*leaves[:4], s.camera, colors=leaves[4])
        lists, depths = splats.lists, splats.projection.depths
        tile = torch.repeat_interleave(lists.lengths)
        keys = torch.stack(
            [tile.cpu().double(), depths[lists.gaussians].cpu().double(), lists.gaussians.cpu().double()]
        )
        assert all(a <= b for a, b in zip(keys.T.tolist(), keys.T.tolist()[1:], strict=False))  # of equals, by number
        assert torch.equal(lists.touched.cpu().nonzero()[:, 0], lists.gaussians.cpu().long().unique())
        pairs.append(set(zip(tile.tolist(), lists.gaussians.tolist(), strict=True)))
    reached = {}
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in (s.camera.height, s.camera.width)), indexing="ij")
    for tile, i in pairs[0] ^ pairs[1]:
        (mx, my), (l11, l21, l22) = splats.projection.means[i].double(), splats.projection.factors[i].double()
        raw = splats.opacities[i] * torch.exp(-0.5 * ((l11 * (x - mx) + l21 * (y - my)) ** 2 + (l22 * (y - my)) ** 2))
        row, column = divmod(tile, lists.columns)
        reached[tile, i] = raw[row * TILE :, column * TILE :][:TILE, :TILE].max() / MIN_ALPHA
    assert all(value < 1 + 1e-3 for value in reached.values())
    assert len(reached) <= 0.02 * len(pairs[1])


@pytest.mark.slow
@pytest.mark.parametrize("render", [plain, random_moments])
def test_deterministic_gradients(render):
    s = SCENES["a thick stack"]()
    w = weights(5 if render is plain else 7, s)
    by_atomics = outcome("triton", s, w, render).gradients
    torch.use_deterministic_algorithms(True)
    try:
        ordered, again = (outcome("triton", s, w, render).gradients for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(False)
    for a, b, c in zip(ordered, by_atomics, again, strict=True):
        close(a, b, b, GRADIENT)
        assert torch.equal(a, c)


@pytest.mark.slow
def test_a_step_on_the_expectation_and_a_guard(monkeypatch):
    """A guard of an opaque model at one camera; pixels at the cut of 1/255 are among them, hence the tolerances."""
    monkeypatch.setattr(shares_module, "amid_views", lambda scene: [])
    scene, found = synthetic_scene(width=12, height=9, points=30), []
    for engine, device in (("triton", DEVICE), ("torch", "cpu")):
        use_engine(engine)
        trainer = Trainer(scene, TrainConfig(iterations=1, dropout=0.2, analytic=True), device)
        trainer.train_step()
        model = model_of(trainer)
        opaque = replace(model.gaussians, opacity_logits=torch.full_like(model.gaussians.opacity_logits, 3.0))
        guarded = shares_module.guard(replace(model, gaussians=opaque), scene, unseen_views(scene)[:1], rounds=1)
        found.append((float(trainer.loss), guarded.keep.cpu(), guarded.scores))
    (mine, kept, scores), (theirs, theirs_kept, theirs_scores) = found
    assert mine == pytest.approx(theirs, rel=1e-3)
    assert torch.equal(kept, theirs_kept)
    assert scores == pytest.approx(theirs_scores, rel=1e-2)
    assert scores[0] > 0


def test_what_it_cannot_do_is_refused_by_name():
    s = scene(3, 9, 7).to(torch.float32, DEVICE)
    use_engine("triton")
    moving = Camera(s.camera.world_to_camera.clone().requires_grad_(), 9.0, 9.0, 4.0, 3.0, 9, 7)
    with pytest.raises(NotImplementedError, match=r"triton .*camera's pose"):
        splat(*s[:4], moving, colors=s.colors)


def test_float64_is_for_torch():
    use_engine("triton")
    s = scene(3, 9, 7)
    assert splat(*s[:4], s.camera, colors=s.colors).engine.name == "torch"
