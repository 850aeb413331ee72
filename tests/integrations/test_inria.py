"""The hook on the rasterizers of the INRIA family."""

import pytest
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render, rasterize
from torch import nn

from ca_reg import GaussianDropout, OpacityNoise
from ca_reg.integrations.inria import RasterizerHook
from ca_reg.schedules import StartStop
from reference_trainer.training.density.operations import DensityStatistics

BLACK = torch.zeros(3)
FORMS = ["plain", "inverse-depth", "weights", "depth-alpha"]


def loss_of(image):
    weights = torch.linspace(0.5, 1.5, image.numel(), device=image.device)
    return (image * weights.reshape(image.shape)).sin().sum()


class Bookkeeping:
    """What the family keeps for densification, written from its description."""

    def __init__(self, n, device):
        self.accumulated, self.count = torch.zeros(n, device=device), torch.zeros(n, device=device)
        self.radii = torch.zeros(n, dtype=torch.int32, device=device)

    def add(self, gradient, visible, radii):
        self.radii[visible] = torch.maximum(self.radii[visible], radii[visible])
        self.accumulated[visible] += gradient[visible, :2].norm(dim=-1)
        self.count[visible] += 1

    def mean(self):
        return (self.accumulated / self.count).nan_to_num()


@pytest.mark.parametrize("form", FORMS)
def test_masking_with_zeroed_radii_is_removing_the_gaussians(form, device):
    rasterizer, model = make_rasterizer(form), Model(device=device)
    render, n, black = make_render(rasterizer), 60, BLACK.to(device)
    dropout = GaussianDropout(0.4)
    hooked, removed, naive = (Bookkeeping(n, device) for _ in range(3))
    ours = DensityStatistics.zeros(n, device)
    hook = RasterizerHook(dropout, rasterizer=rasterizer)
    for step in range(1, 6):
        with hook:
            hook.step(step)
            package = render(model.camera, model, PIPE, black)
        gradients = torch.autograd.grad(loss_of(package["render"]), model.parameters())
        points = package["viewspace_points"].grad
        hooked.add(points, package["visibility_filter"], package["radii"])

        keep = dropout.keep.nonzero().squeeze(1)
        subset = render(model.camera, model, PIPE, black, keep=keep)
        expected = torch.autograd.grad(loss_of(subset["render"]), model.parameters())
        torch.testing.assert_close(package["render"], subset["render"], rtol=1e-6, atol=1e-6)
        for ours_, theirs in zip(gradients, expected, strict=True):
            # A card adds up in any order, so that a sum that nearly cancels errs by the rounding of its summands.
            rounding = 1e-7 * theirs.abs().max().item() if device.type == "cuda" else 0.0
            torch.testing.assert_close(ours_, theirs, rtol=1e-6, atol=rounding)
        full_radii = torch.zeros(n, dtype=torch.int32, device=device)
        full_points = torch.zeros(n, 3, device=device)
        full_radii[keep], full_points[keep] = subset["radii"], subset["viewspace_points"].grad
        removed.add(full_points, full_radii > 0, full_radii)

        # The reference trainer's own statistics, given the visible subset, in pixels.
        seen = full_radii.nonzero().squeeze(1)
        per_pixel = full_points[seen, :2] / torch.tensor([16.0, 12.0], device=device)
        ours.update(seen, torch.ones_like(seen, dtype=torch.bool), per_pixel, 32, 24)
        with torch.no_grad():
            unmasked = render(model.camera, model, PIPE, black)["radii"]
        naive.add(points, unmasked > 0, unmasked)

    assert hook.tally.regularized == 5
    assert 0 < removed.count.sum() < naive.count.sum()
    assert torch.equal(hooked.count, removed.count)
    assert torch.equal(hooked.radii, removed.radii)
    torch.testing.assert_close(hooked.mean(), removed.mean(), rtol=1e-6, atol=0)
    torch.testing.assert_close(hooked.mean(), ours.mean_gradient, rtol=1e-5, atol=0)
    threshold = removed.mean().sort().values[n // 2 - 1 : n // 2 + 1].mean()  # between two of them
    assert torch.equal(hooked.mean() >= threshold, removed.mean() >= threshold)
    # Without the zeroed radii the means shrink and fewer Gaussians are densified: the comparison can fail.
    assert (naive.mean() >= threshold).sum() < (hooked.mean() >= threshold).sum()


def test_renders_without_gradients_are_scaled_and_keep_their_radii(rasterizer):
    model, render = Model(), make_render(rasterizer)
    with torch.no_grad():
        plain = render(model.camera, model, PIPE, BLACK)
        expected = render(model.camera, model, PIPE, BLACK, opacities=0.7 * model.get_opacity)
        with RasterizerHook(GaussianDropout(0.3), rasterizer=rasterizer) as hook:
            scaled = render(model.camera, model, PIPE, BLACK)
    torch.testing.assert_close(scaled["render"], expected["render"])
    assert torch.equal(scaled["radii"], plain["radii"])
    assert (hook.tally.scaled, hook.tally.regularized) == (1, 0)


def test_a_script_that_only_renders_scales_by_the_final_rate(rasterizer):
    dropout = GaussianDropout(StartStop(0.3, start=500))
    model, render = Model(), make_render(rasterizer)
    with torch.no_grad():
        expected = render(model.camera, model, PIPE, BLACK, opacities=0.7 * model.get_opacity)
        with RasterizerHook(dropout, rasterizer=rasterizer) as hook:
            scaled = render(model.camera, model, PIPE, BLACK)
    torch.testing.assert_close(scaled["render"], expected["render"])
    assert hook.tally.scaled == 1


@pytest.mark.parametrize("detached", ["opacities", "means3D"])
def test_depth_renders_are_left_alone_and_counted(rasterizer, detached):
    model, render = Model(), make_render(rasterizer)
    keywords = (
        {"opacities": torch.full((60, 1), 0.95)} if detached == "opacities" else {"means3D": model.get_xyz.detach()}
    )
    plain = render(model.camera, model, PIPE, BLACK, **keywords)
    with RasterizerHook(GaussianDropout(0.3), rasterizer=rasterizer) as hook:
        hook.step(1)
        package = render(model.camera, model, PIPE, BLACK, **keywords)
        assert hook.tally.regularized == 0
        render(model.camera, model, PIPE, BLACK)  # and they do not count as the main view
    assert torch.equal(package["render"], plain["render"])
    assert torch.equal(package["radii"], plain["radii"])
    assert sum(hook.tally.skipped.values()) == 1
    assert hook.tally.regularized == 1


@pytest.mark.parametrize("scope", ["main", "all"])
def test_scope_and_one_mask_per_model_and_iteration(rasterizer, model_class, scope):
    models, render = [model_class(), model_class()], make_render(rasterizer)
    plain = render(models[0].camera, models[0], PIPE, BLACK)["radii"]
    with RasterizerHook(GaussianDropout(0.5), scope=scope, rasterizer=rasterizer) as hook:
        masks = []
        for iteration in (1, 2):
            for model in models:
                model.update_learning_rate(iteration)
            for model in models:
                first, batch = (render(model.camera, model, PIPE, BLACK)["radii"] for _ in range(2))
                pseudo = render(model.camera, model, PIPE, BLACK)["radii"]
                assert torch.equal(batch, first)
                assert torch.equal(pseudo, plain if scope == "main" else first)
                masks.append(first)
    assert all(not torch.equal(a, b) for i, a in enumerate(masks) for b in masks[:i])
    assert hook.tally.regularized == (8 if scope == "main" else 12)


def test_masks_follow_from_seed_and_step_and_leave_the_global_random_numbers_alone(rasterizer):
    def run(seed, steps):
        model, before = Model(), torch.get_rng_state()
        with RasterizerHook(GaussianDropout(0.5), seed=seed, rasterizer=rasterizer) as hook:
            for step in steps:
                hook.step(step)
                radii = make_render(rasterizer)(model.camera, model, PIPE, BLACK)["radii"]
        assert torch.equal(torch.get_rng_state(), before)
        return radii

    assert torch.equal(run(0, [1, 2, 3]), run(0, [3]))
    assert not torch.equal(run(0, [3]), run(1, [3]))


def test_logits_are_refused_even_if_the_module_was_called_before(rasterizer):
    dropout, model = GaussianDropout(0.4), Model()
    dropout(torch.full((3,), 0.5))
    with pytest.raises(ValueError, match="activated"), RasterizerHook(dropout, rasterizer=rasterizer):
        rasterize(rasterizer, model, model.camera, BLACK, opacities=model.parameters()[3])


@pytest.mark.parametrize(
    ("arguments", "at_end"),
    [
        ([1, 2, 3, 4, 5], False),
        ([1, 2, 3, 4, 5], True),  # FSGS, CoR-GS
        ([0, 0, 0, 0, 1], False),  # DNGaussian: offset, so calls are counted
    ],
)
def test_the_schedule_follows_the_learning_rate_updates(rasterizer, model_class, arguments, at_end):
    model, render = model_class(), make_render(rasterizer)
    with RasterizerHook(GaussianDropout(StartStop(0.5, start=3, stop=5)), rasterizer=rasterizer) as hook:
        done = []
        for argument in arguments:
            if not at_end:
                model.update_learning_rate(argument)
            before = hook.tally.regularized
            render(model.camera, model, PIPE, BLACK)
            done.append(hook.tally.regularized - before)
            if at_end:
                assert model.update_learning_rate(argument) == 1e-3 * 0.5**argument
    assert done == [0, 0, 1, 1, 0]
    assert (hook.tally.first_step, hook.tally.last_step) == (3, 4)


def test_a_resumed_training_goes_on_at_its_step(rasterizer, model_class):
    model, dropout = model_class(), GaussianDropout(0.5)
    with RasterizerHook(dropout, rasterizer=rasterizer):
        for iteration in (3001, 3002):
            model.update_learning_rate(iteration)
            make_render(rasterizer)(model.camera, model, PIPE, BLACK)
    assert dropout.step == 3002


def test_steps_that_nobody_tells_are_an_error(rasterizer):
    model, render = Model(), make_render(rasterizer)
    optimizer = torch.optim.Adam(model.parameters())
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        render(model.camera, model, PIPE, BLACK)["render"].sum().backward()
        optimizer.step()
        with pytest.raises(RuntimeError, match=r"hook\.step\(iteration\)"):
            render(model.camera, model, PIPE, BLACK)
        hook.step(2)
        render(model.camera, model, PIPE, BLACK)
    assert hook.tally.regularized == 2


def test_a_viewer_sees_the_test_render_and_is_not_the_main_view(rasterizer):
    class MiniCam:
        def __init__(self, camera):
            self.__dict__.update(vars(camera))

    model, render = Model(), make_render(rasterizer)
    expected = render(model.camera, model, PIPE, BLACK, opacities=0.5 * model.get_opacity)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        hook.step(1)
        seen = render(MiniCam(model.camera), model, PIPE, BLACK)
        render(model.camera, model, PIPE, BLACK)
    torch.testing.assert_close(seen["render"], expected["render"])
    assert (hook.tally.scaled, hook.tally.regularized) == (1, 1)


def hooked_call(regularizer, rasterizer, **variables):
    """Rasterize in a function named render with these variables, as those of the code bases have them."""
    body = "def render(rasterize, dropout_factor=0.0, sigma_noise=0.0, train=True):\n"
    namespace = {"__name__": "gaussian_renderer"}
    exec(body + "    return rasterize()", namespace)
    model = Model()
    with RasterizerHook(regularizer, rasterizer=rasterizer) as hook:
        hook.step(1)
        namespace["render"](lambda: rasterize(rasterizer, model, model.camera, BLACK), **variables)
    return hook.tally


@pytest.mark.parametrize(
    ("regularizer", "variables", "message"),
    [
        (GaussianDropout(0.2), {"dropout_factor": 0.2}, "GaussianDropout .* twice.*--dropout_factor 0"),
        (OpacityNoise(0.8), {"sigma_noise": 0.8}, "OpacityNoise .* twice.*--sigma_noise 0"),
        (nn.Sequential(OpacityNoise(0.8), GaussianDropout(0.2)), {"dropout_factor": 0.2}, "--dropout_factor 0"),
    ],
)
def test_a_second_regularizer_of_the_same_kind_is_refused(rasterizer, regularizer, variables, message):
    with pytest.raises(RuntimeError, match=message):
        hooked_call(regularizer, rasterizer, **variables)
    assert hooked_call(regularizer, rasterizer, **dict.fromkeys(variables, 0)).regularized == 1


def test_a_second_scaling_at_test_time_is_refused(rasterizer):
    with torch.no_grad(), pytest.raises(RuntimeError, match="--dropout_factor 0"):
        hooked_call(GaussianDropout(0.2), rasterizer, dropout_factor=0.2, train=False)


@pytest.mark.parametrize(
    ("regularizer", "variables"),
    [(GaussianDropout(0.2), {"sigma_noise": 0.8}), (OpacityNoise(0.8), {"dropout_factor": 0.2})],
)
def test_regularizers_of_different_kinds_go_together(rasterizer, regularizer, variables):
    assert hooked_call(regularizer, rasterizer, **variables).regularized == 1
