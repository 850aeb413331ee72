"""The gsplat adapter against a stand-in with gsplat's signature, gsplat's own density control, and, on a GPU, gsplat.

On a machine with a CUDA device: ``pip install 'gsplat>=1.5' && pytest tests/integrations/test_gsplat.py -m gpu``.
"""

import copy
import functools
import sys

import pytest
import torch
from stand_ins.card import CardTensor, counted_synchronizations
from stand_ins.gsplat import activated, rasterization, rasterization_1_4, rasterization_that_culls_nothing
from torch import nn

from ca_reg import GaussianDropout, OpacityNoise
from ca_reg.functional import apply_dropout
from ca_reg.integrations.gsplat import install, regularized
from ca_reg.schedules import LinearRamp

N = 60


def select(splats, which):
    return {name: x[which] for name, x in splats.items()}


def loss_of(images):
    weights = torch.linspace(-1, 1, images.numel()).reshape(images.shape).to(images)
    return (images * weights).sum()


@pytest.mark.parametrize(
    ("stand_in", "packed"), [(rasterization, True), (rasterization, False), (rasterization_1_4, False)]
)
def test_masked_and_removed_gaussians_give_the_same_images_and_gradients(stand_in, packed, params, cameras, device):
    params = params.to(device)
    cameras = {name: x.to(device) if isinstance(x, torch.Tensor) else x for name, x in cameras.items()}
    dropout = GaussianDropout(0.4)
    wrapped = regularized(stand_in, dropout, generator=torch.Generator().manual_seed(1))
    image, alpha, info = wrapped(**activated(params), **cameras, packed=packed)
    loss_of(image).backward()
    masked_gradients = {name: x.grad.clone() for name, x in params.items()}

    kept = dropout.keep.nonzero().squeeze(1)
    assert 0 < len(kept) < N
    params.zero_grad()
    expected, expected_alpha, plain = stand_in(**select(activated(params), kept), **cameras, packed=packed)
    loss_of(expected).backward()
    torch.testing.assert_close(image, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(alpha, expected_alpha, rtol=1e-6, atol=1e-6)
    for name, x in params.items():
        torch.testing.assert_close(masked_gradients[name], x.grad, rtol=1e-5, atol=1e-6)

    if packed:
        assert torch.equal(info["gaussian_ids"], kept[plain["gaussian_ids"]])
        assert torch.equal(info["radii"], plain["radii"])
    else:
        assert torch.equal(info["radii"][:, kept], plain["radii"])
        assert not info["radii"][:, ~dropout.keep].any()
        # Without the adapter, 1.4 counts the dropped ones that lie in view.
        raw = activated(params) | {"opacities": apply_dropout(params["opacities"].sigmoid(), dropout.keep)}
        leaked = stand_in(**raw, **cameras, packed=False)[2]["radii"][:, ~dropout.keep].any()
        assert bool(leaked) == (stand_in is rasterization_1_4)


@pytest.mark.parametrize(
    ("stand_in", "packed"),
    [(rasterization, True), (rasterization, False), (rasterization_that_culls_nothing, False)],
    ids=["packed", "unpacked", "unpacked, culls nothing"],
)
def test_gsplats_own_density_control_decides_as_if_dropped_gaussians_were_not_there(stand_in, packed, params, cameras):
    strategies = pytest.importorskip("gsplat.strategy", exc_type=ImportError)

    def strategy():
        return strategies.DefaultStrategy(
            refine_start_iter=0, refine_every=4, grow_grad2d=0.5, grow_scale3d=0.1, refine_scale2d_stop_iter=100
        )

    def train(params, render):
        """Four steps of which the last refines."""
        optimizers = {name: torch.optim.SGD([x], lr=0.0) for name, x in params.items()}
        control = strategy()
        control.check_sanity(params, optimizers)
        state = control.initialize_state()
        counts = []
        for step in range(1, 5):
            image, info = render(params, step)
            control.step_pre_backward(params, optimizers, state, step, info)
            loss_of(image).backward()
            if step == 4:
                counts = [state[x].clone() for x in ("count", "grad2d", "radii")]
                torch.manual_seed(0)  # of the splits
            control.step_post_backward(params, optimizers, state, step, info, packed=packed)
            params.zero_grad()
        return params, counts

    dropout = GaussianDropout(0.4)
    wrapped = regularized(stand_in, dropout, generator=torch.Generator().manual_seed(5))
    masks = []

    def masked(params, step):
        image, _, info = wrapped(**activated(params), **cameras, packed=packed)
        masks.append(dropout.keep)
        return image, info

    def removed(params, step):
        """The way of the paper's code: the rest is rendered alone, and its statistics entered at their own places."""
        kept = masks[step - 1].nonzero().squeeze(1)
        if packed:
            image, _, info = stand_in(**select(activated(params), kept), **cameras)
            return image, info | {"gaussian_ids": kept[info["gaussian_ids"]]}
        # Unpacked statistics have a place for everyone. The dropped ones are put behind the cameras.
        splats = activated(params)
        behind = -5 * cameras["viewmats"][0, 2, :3]
        splats["means"] = torch.where(masks[step - 1][:, None], splats["means"], behind)
        image, _, info = stand_in(**splats, **cameras, packed=False)
        return image, info

    one, counts = train(copy.deepcopy(params), masked)
    other, expected = train(copy.deepcopy(params), removed)
    assert len(one["means"]) != N  # something was decided
    for name in one:
        torch.testing.assert_close(one[name], other[name], rtol=1e-6, atol=1e-6)
    for x, y in zip(counts, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)
    # The count is that of the masks: a Gaussian in full view of both cameras is seen twice for every step it was in.
    assert counts[0].max() == 6
    assert (counts[0] <= 2 * torch.stack(masks[:3]).sum(0)).all()


def test_packed_mode_of_old_versions_is_refused(params, cameras):
    wrapped = regularized(rasterization_1_4, GaussianDropout(0.4))
    with pytest.raises(RuntimeError, match=r"pass packed=False, or.* install gsplat>=1\.5"):
        wrapped(**activated(params), **cameras)


def test_training_is_told_by_mode_and_by_gradient(params, cameras):
    dropout = GaussianDropout(0.5)
    wrapped = regularized(rasterization, dropout)
    splats = activated(params)
    scaled = rasterization(**splats | {"opacities": 0.5 * splats["opacities"]}, **cameras)[0]
    frozen = splats | {"opacities": splats["opacities"].detach()}

    def evaluates(splats):
        before = wrapped.tally.scaled
        torch.testing.assert_close(wrapped(**splats, **cameras)[0], scaled, rtol=0, atol=0)
        assert dropout.keep is None
        return wrapped.tally.scaled == before + 1

    with torch.no_grad():
        assert evaluates(splats)
    assert evaluates(frozen)
    assert dropout.training  # as it was
    dropout.eval()
    assert evaluates(splats)
    dropout.train()
    wrapped(**splats, **cameras)
    assert dropout.keep is not None
    assert (wrapped.tally.regularized, wrapped.tally.scaled) == (1, 3)


def test_the_modes_of_the_parts_survive_an_evaluation(params, cameras):
    regularizer = nn.Sequential(OpacityNoise(0.5), GaussianDropout(0.5).eval())
    with torch.no_grad():
        regularized(rasterization, regularizer)(**activated(params), **cameras)
    assert [m.training for m in regularizer.modules()] == [True, True, False]


def test_composed_noise_and_dropout_with_a_generator_leave_the_global_one_alone(params, cameras):
    regularizer = nn.Sequential(OpacityNoise(0.8), GaussianDropout(0.3))
    images = []
    for _ in range(2):
        state = torch.get_rng_state()
        wrapped = regularized(rasterization, regularizer, generator=torch.Generator().manual_seed(7))
        image, _, info = wrapped(**activated(params), **cameras, packed=False)
        assert torch.equal(torch.get_rng_state(), state)
        images.append(image)
    assert torch.equal(*images)
    noise, dropout = regularizer
    dropped = ~dropout.keep | (noise.noise <= -1)  # the clamp at 0 drops as well
    assert not info["radii"][:, dropped].any()
    opacities = apply_dropout((params["opacities"].sigmoid() * (1 + noise.noise)).clamp(0, 1), dropout.keep)
    expected = rasterization(**activated(params) | {"opacities": opacities}, **cameras)[0]
    torch.testing.assert_close(images[0], expected, rtol=0, atol=1e-6)


def test_nothing_to_do_passes_the_very_same_tensor(params):
    seen = []

    def spy(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
        seen.append(opacities)
        return opacities, opacities, {}

    opacities = params["opacities"].sigmoid()
    regularized(spy, GaussianDropout(0.0))(0, 0, 0, opacities, 0, 0, 0, 8, 8)  # positional, and an info without radii
    assert seen[0] is opacities


def test_batches_are_rendered_as_one_set():
    def stand_in(means, quats, scales, opacities, colors, viewmats, Ks, width, height, packed=True):
        batches, n = opacities.shape
        info = {"radii": torch.ones(batches, 3, n, 2, dtype=torch.int32), "gaussian_ids": None}
        if packed:
            at = (opacities > 0).nonzero()
            info = {"radii": torch.ones(len(at), 2), "batch_ids": at[:, 0], "gaussian_ids": at[:, 1]}
        return opacities, opacities, info

    opacities = torch.full((2, 40), 0.9, requires_grad=True)
    wrapped = regularized(stand_in, GaussianDropout(0.5))
    kept = wrapped(0, 0, 0, opacities, 0, 0, 0, 8, 8, packed=False)
    expected = (kept[0] > 0)[:, None, :, None].expand(2, 3, 40, 2)
    assert torch.equal(kept[2]["radii"] > 0, expected)
    assert not torch.equal(kept[0][0], kept[0][1])
    assert wrapped(0, 0, 0, opacities, 0, 0, 0, 8, 8)[2]["gaussian_ids"].numel() > 0


@pytest.mark.slow
# Dynamo asks every tensor that crosses a cut for its gradient.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_a_compiled_call_is_regularized(params, cameras):
    dropout = GaussianDropout(0.5)
    wrapped = regularized(rasterization, dropout)

    @torch.compile(backend="eager")
    def loss(params):
        return wrapped(**activated(params), **cameras)[0].sum() * 2

    expected = []
    for _ in range(2):
        value = loss(params)
        opacities = apply_dropout(params["opacities"].sigmoid(), dropout.keep)
        plain = rasterization(**activated(params) | {"opacities": opacities}, **cameras)[0].sum() * 2
        expected.append(plain.item())
        assert value.item() == pytest.approx(plain.item(), rel=1e-5)
    assert expected[0] != expected[1]
    assert wrapped.tally.regularized == 2


def test_mistakes_are_told(monkeypatch):
    wrapped = regularized(rasterization, GaussianDropout(0.2))
    with pytest.raises(ValueError, match="regularized already"):
        regularized(wrapped, GaussianDropout(0.2))
    with pytest.raises(TypeError, match="module, got float"):
        regularized(rasterization, 0.2)
    with pytest.raises(TypeError, match="no argument opacities"):
        regularized(lambda image: image, GaussianDropout(0.2))
    with pytest.raises(TypeError, match=r"missing .*argument"):
        wrapped()
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"pip install 'ca_reg\[gsplat\]'"):
        install(GaussianDropout(0.2))


@pytest.mark.gpu
@pytest.mark.parametrize("packed", [True, False])
def test_gsplat_itself_renders_and_counts_as_without_the_dropped_gaussians(packed, params, cameras):
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    gsplat = pytest.importorskip("gsplat", exc_type=ImportError)
    params = params.cuda()
    cameras = {name: x.cuda() if isinstance(x, torch.Tensor) else x for name, x in cameras.items()}
    dropout = GaussianDropout(0.4)
    wrapped = regularized(gsplat.rasterization, dropout, generator=torch.Generator("cuda").manual_seed(1))
    image, _, info = wrapped(**activated(params), **cameras, packed=packed)
    info["means2d"].retain_grad()
    loss_of(image).backward()
    found = {name: x.grad.clone() for name, x in params.items()}
    kept = dropout.keep.nonzero().squeeze(1)
    params.zero_grad()
    expected, _, plain = gsplat.rasterization(**select(activated(params), kept), **cameras, packed=packed)
    plain["means2d"].retain_grad()
    loss_of(expected).backward()
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-5)
    for name, x in params.items():  # the kernels add in any order
        scale = x.grad.abs().max()
        torch.testing.assert_close(found[name] / scale, x.grad / scale, rtol=1e-3, atol=1e-5)
    if packed:
        assert torch.equal(info["gaussian_ids"].long(), kept[plain["gaussian_ids"].long()])
    else:
        assert torch.equal(info["radii"][:, kept], plain["radii"])
        assert not info["radii"][:, ~dropout.keep].any()
        torch.testing.assert_close(info["means2d"].grad[:, kept], plain["means2d"].grad, rtol=1e-3, atol=1e-4)


def test_a_draw_that_drops_nothing_does_not_vouch_for_packed_mode(params, cameras):
    """The Gaussians of opacity 0 are looked for until enough were dropped that some would have been listed."""
    dropout = GaussianDropout(LinearRamp(1e-9, 0.4, 2, 3))
    wrapped = regularized(rasterization_1_4, dropout)
    for _ in range(3):
        wrapped(**activated(params), **cameras)
        assert dropout.keep.all()
    dropout.set_step(3)
    with pytest.raises(RuntimeError, match="pass packed=False"):
        wrapped(**activated(params), **cameras)


def test_dropped_gaussians_are_hidden_on_several_gpus_too(params, cameras):
    """gsplat's info holds the Gaussians of the rank, before they are exchanged."""

    @functools.wraps(rasterization)
    def over_ranks(*args, distributed=False, **kwargs):
        assert distributed
        return rasterization_that_culls_nothing(*args, **kwargs)

    dropout = GaussianDropout(0.4)
    info = regularized(over_ranks, dropout)(**activated(params), **cameras, packed=False, distributed=True)[2]
    assert 0 < dropout.keep.sum() < N
    assert info["radii"][:, dropout.keep].any()
    assert not info["radii"][:, ~dropout.keep].any()


@pytest.mark.parametrize("packed", [True, False])
def test_a_warm_step_does_not_wait_for_the_card(card, packed):
    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
        radii, ids = torch.ones(1, len(opacities), 2, dtype=torch.int32, device=card), None
        if packed:  # gsplat itself waits for these numbers; here it is not counted
            radii, ids = radii[0], CardTensor((opacities.detach().numbers > 0).nonzero()[:, 0])
        return opacities, opacities, {"radii": radii, "gaussian_ids": ids}

    wrapped, logits = regularized(rasterization, GaussianDropout(0.5)), torch.zeros(50, device=card, requires_grad=True)
    waits = []
    for _ in range(3):
        with counted_synchronizations() as found:
            wrapped(None, None, None, logits.sigmoid(), None, None, None, 8, 8)[0].sum().backward()
        waits.append(found.total())
    assert waits[1:] == [0, 0]
