"""The hook of the INRIA family notices what is not regularized: steps, viewers, zeros, other rasterizers."""

import gc
import re
import sys
import weakref
from types import ModuleType

import numpy as np
import pytest
import torch
from stand_ins.card import counted_synchronizations, pretended_card
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render, rasterize
from torch import nn

from ca_reg import GaussianDropout, OpacityNoise
from ca_reg.decay import OpacityDecay
from ca_reg.integrations.inria import RasterizerHook
from ca_reg.schedules import LinearRamp, StartStop

BLACK = torch.zeros(3)


def optimizer_of(model, name="opacity", kind=torch.optim.Adam):
    """As the family makes it: a group of parameters for each name."""
    groups = [{"params": [x], "name": name if x is model._opacity else "other"} for x in model.parameters()]
    return kind(groups, lr=1e-3)


def train(model, render, optimizer, camera=None, views=1, **replaced):
    """Make a step; return what the first view saw."""
    optimizer.zero_grad()
    packages = [render(camera or model.camera, model, PIPE, BLACK, **replaced) for _ in range(views)]
    sum(package["render"].sum() for package in packages).backward()
    optimizer.step()
    return packages[0]["radii"] > 0


def densify(model, optimizer):
    """Replace the parameters in the model and in its optimizer, as the family does."""
    for group, name in zip(optimizer.param_groups, ("_xyz", "_scaling", "_rotation", "_opacity"), strict=False):
        optimizer.state.pop(group["params"][0])
        group["params"][0] = nn.Parameter(group["params"][0].detach().clone())
        setattr(model, name, group["params"][0])


def computed_means(model):
    """Positions of a deformed model."""
    return {"means3D": model.get_xyz + 0.0 * model.get_scaling}


def test_an_iteration_may_have_any_name(rasterizer, monkeypatch):
    class GaussianModel(Model):
        def update_learning_rate(self, step):
            return step

    monkeypatch.setitem(sys.modules, "my_model", module := ModuleType("my_model"))
    module.GaussianModel = GaussianModel
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, models=["my_model:GaussianModel"]) as hook:
        model = GaussianModel()
        assert model.update_learning_rate(step=7) == 7
        make_render(rasterizer)(model.camera, model, PIPE, BLACK)
    assert hook.tally.first_step == 7


@pytest.mark.parametrize("deformed", [False, True])
def test_updates_of_every_tenth_step_are_noticed(rasterizer, model_class, deformed):
    model, render = model_class(), make_render(rasterizer)
    optimizer = optimizer_of(model)
    replaced = computed_means(model) if deformed else {}
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer):
        model.update_learning_rate(1)
        train(model, render, optimizer, **replaced)
        with pytest.raises(RuntimeError, match=r'update_learning_rate .* steps="parameters".*hook\.step\(iteration\)'):
            train(model, render, optimizer, **(computed_means(model) if deformed else {}))


def test_computed_positions_of_nobodys_steps_are_noticed(rasterizer):
    model, render = Model(), make_render(rasterizer)
    optimizer = optimizer_of(model)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer):
        train(model, render, optimizer, **computed_means(model))
        with pytest.raises(RuntimeError, match=r"tell .*steps apart"):
            train(model, render, optimizer, **computed_means(model))


@pytest.mark.parametrize("deformed", [False, True])
@pytest.mark.parametrize("every", [0, 10])
def test_the_parameters_tell_the_steps(rasterizer, model_class, deformed, every):
    model, render = (model_class if every else Model)(), make_render(rasterizer)
    optimizer, dropout = optimizer_of(model), GaussianDropout(StartStop(0.5, start=3))
    seen, masks = [], []
    with RasterizerHook(dropout, rasterizer=rasterizer, steps="parameters") as hook:
        for iteration in range(1, 25):
            if every and iteration % every == 1:
                model.update_learning_rate(iteration)
            if iteration == 12:
                densify(model, optimizer)
            masks.append(train(model, render, optimizer, views=2, **(computed_means(model) if deformed else {})))
            seen.append(dropout.step)
    assert seen == list(range(1, 25))
    assert hook.tally.regularized == 44  # both views of 22 steps: a batch, as they are rendered in one loop
    assert all(not torch.equal(a, b) for i, a in enumerate(masks[2:]) for b in masks[2:][:i])


def test_two_models_with_computed_positions_are_two(rasterizer):
    models, render = [Model(seed=0), Model(seed=0)], make_render(rasterizer)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        hook.step(1)
        first, second = (render(m.camera, m, PIPE, BLACK, **computed_means(m))["radii"] for m in models)
    assert hook.tally.regularized == 2
    assert not torch.equal(first, second)


class MiniCam:
    """As network_gui makes it."""

    def __init__(self, camera):
        self.__dict__.update(vars(camera))


@pytest.mark.parametrize("regularizer", [GaussianDropout(0.5), OpacityNoise(0.5)])
def test_training_on_the_views_of_a_viewer_is_an_error_at_once(rasterizer, model_class, regularizer):
    model, render = model_class(), make_render(rasterizer)
    optimizer, camera = optimizer_of(model), MiniCam(model.camera)
    with RasterizerHook(regularizer, rasterizer=rasterizer):
        model.update_learning_rate(1)
        with pytest.raises(RuntimeError, match=r"MiniCam.*viewer=None.*--viewer none"):
            train(model, render, optimizer, camera)
    with RasterizerHook(regularizer, rasterizer=rasterizer, viewer=None) as hook:
        model.update_learning_rate(1)
        train(model, render, optimizer, camera)
    assert hook.tally.regularized == 1


def follow(hook, step):
    """Make steps in a hook until it raises; return its message and how many steps were made."""
    number, message = 0, ""
    while number < 30 and not message:
        number += 1
        try:
            step(number)
        except RuntimeError as error:
            message = str(error)
    hook.uninstall()
    return message, number


@pytest.mark.parametrize("updates", [True, False])
def test_a_training_past_the_hook_is_ended_early(rasterizer, model_class, updates):
    """As 2DGS trains where both rasterizers are installed."""
    model, other = model_class(), make_render(make_rasterizer())
    optimizer = optimizer_of(model)

    def step(iteration):
        if updates:
            model.update_learning_rate(iteration)
        train(model, other, optimizer)

    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, patience=3).install()
    message, made = follow(hook, step)
    assert made == 4
    assert re.search("4 optimizer steps .*GaussianRasterizer.*rasterizer=.*--patience", message)


def test_steps_past_the_hook_among_others_are_counted(rasterizer, model_class):
    model, ours, other = model_class(), make_render(rasterizer), make_render(make_rasterizer())
    optimizer = optimizer_of(model)

    def step(iteration):
        model.update_learning_rate(iteration)
        train(model, ours if iteration % 2 else other, optimizer)

    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, patience=4).install()
    message, made = follow(hook, step)
    assert made == 11
    assert "5 training steps" in message
    assert (hook.tally.regularized, hook.tally.lost) == (5, 5)


def test_a_step_is_an_integer_of_python_or_numpy(rasterizer):
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        hook.step(np.int64(3))
        make_render(rasterizer)((model := Model()).camera, model, PIPE, BLACK)
        for step in (3.0, torch.tensor(3)):
            with pytest.raises(TypeError, match=r"step .*integer"):
                hook.step(step)
    assert hook.tally.first_step == 3


def test_said_steps_without_a_render_are_counted(rasterizer):
    model, render = Model(), make_render(rasterizer)
    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, patience=2).install()

    def step(number):
        hook.step(number)
        if number < 3:
            render(model.camera, model, PIPE, BLACK)

    message, made = follow(hook, step)
    assert (made, hook.tally.lost) == (6, 3)
    assert "3 training steps" in message


def test_a_short_training_past_the_hook_is_an_error_at_its_end(rasterizer):
    model, other = Model(), make_render(make_rasterizer())
    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer)
    with pytest.raises(RuntimeError, match="not regularized"), hook:
        train(model, other, optimizer_of(model))
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, patience=0):
        train(model, other, optimizer_of(model))


@pytest.mark.parametrize("name", ["opacity", "poses"])
def test_other_optimizers_and_schedules_are_no_cause_for_alarm(rasterizer, model_class, name):
    model, render = model_class(), make_render(rasterizer)
    poses, optimizer = optimizer_of(model_class(), name="poses"), optimizer_of(model, name)
    regularizer = GaussianDropout(LinearRamp(0.0, 0.5, 7, 8))
    with RasterizerHook(regularizer, rasterizer=rasterizer, patience=2) as hook:
        for iteration in range(1, 10):
            model.update_learning_rate(iteration)
            for _ in range(3):
                for group in poses.param_groups:
                    group["params"][0].grad = torch.zeros_like(group["params"][0])
                poses.step()
            train(model, render, optimizer)
    assert hook.tally.regularized == 2
    assert hook.problem() is None


def test_the_hook_lets_go_of_the_optimizers(rasterizer):
    model, other = Model(), make_render(make_rasterizer())
    optimizer = optimizer_of(model)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, patience=1):
        pass
    for _ in range(3):
        train(model, other, optimizer)


def drop(opacity):
    """A dropout of a code base's own, by no name that is known."""
    generator = torch.Generator().manual_seed(0)
    return opacity * (torch.rand(opacity.shape, generator=generator) > 0.2)


@pytest.mark.parametrize("regularizer", [GaussianDropout(0.2), nn.Sequential(OpacityNoise(0.8), GaussianDropout(0.2))])
def test_a_dropout_of_ones_own_is_told_by_its_zeros(rasterizer, regularizer):
    model, render = Model(), make_render(rasterizer)
    with RasterizerHook(regularizer, rasterizer=rasterizer) as hook:
        hook.step(1)
        with pytest.raises(RuntimeError, match=r"dropped twice: 23\.33% .* --allow-zeros"):
            render(model.camera, model, PIPE, BLACK, opacities=drop(model.get_opacity))
    with RasterizerHook(regularizer, rasterizer=rasterizer, allow_zeros=True) as hook:
        hook.step(1)
        render(model.camera, model, PIPE, BLACK, opacities=drop(model.get_opacity))
    assert hook.tally.regularized == 1


def test_zeros_and_noise_go_together(rasterizer):
    model, render = Model(), make_render(rasterizer)
    with RasterizerHook(OpacityNoise(0.8), rasterizer=rasterizer) as hook:
        hook.step(1)
        render(model.camera, model, PIPE, BLACK, opacities=drop(model.get_opacity))
    assert hook.tally.regularized == 1


def test_an_is_train_beside_an_iteration_is_no_dropout(rasterizer):
    model = Model()

    def render(iteration, is_train):
        return rasterize(rasterizer, model, model.camera, BLACK)

    with RasterizerHook(GaussianDropout(0.2), rasterizer=rasterizer) as hook:
        hook.step(1)
        render(iteration=3, is_train=True)
    assert hook.tally.regularized == 1


@pytest.mark.slow
# Dynamo asks every tensor that crosses a cut for its gradient.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_a_compiled_training_is_regularized(rasterizer, model_class):
    model, render = model_class(), make_render(rasterizer)
    dropout = GaussianDropout(0.5)

    @torch.compile(backend="eager")
    def loss(model):
        return render(model.camera, model, PIPE, BLACK)["render"].sum() * 2

    with RasterizerHook(dropout, rasterizer=rasterizer) as hook:
        for iteration in (1, 2, 3):
            model.update_learning_rate(iteration)
            value = loss(model)
    expected = (
        2 * render(model.camera, model, PIPE, BLACK, opacities=model.get_opacity * dropout.keep[:, None])["render"]
    )
    assert value.item() == pytest.approx(expected.sum().item(), rel=1e-5)
    assert hook.tally.regularized == 3


def test_tensors_of_the_caller_are_released(rasterizer):
    """The hook reads the variables of the function that renders, and must not keep what that deletes."""
    model = Model()

    def render():
        image = rasterize(rasterizer, model, model.camera, BLACK)[0]
        left = weakref.ref(image)
        rasterize(rasterizer, model, model.camera, BLACK)
        del image
        gc.collect()
        return left()

    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, scope="all") as hook:
        hook.step(1)
        assert render() is None


class GaussianRasterizer(nn.Module):
    def forward(self, means3D, means2D, opacities):
        return opacities.mean().expand(3, 4, 5), torch.ones(len(means3D), dtype=torch.int32, device=means3D.device)


def test_a_warm_step_does_not_wait_for_the_device(rasterizer):
    """Nor does it to find zeros; at the latest the end of the training tells of them."""
    with pretended_card() as card:
        means, logits = (torch.zeros(60, n, device=card, requires_grad=True) for n in (3, 1))
        last = torch.ones(60, 1, device=card)
        last[:20] = 0
        with RasterizerHook(GaussianDropout(0.2), rasterizer=GaussianRasterizer) as hook:
            waits = []
            for step in range(1, 41):
                hook.step(step)
                opacities = logits.sigmoid() * (last if step == 40 else 1.0)
                with counted_synchronizations() as found:
                    GaussianRasterizer()(means3D=means, means2D=None, opacities=opacities)
                waits.append(found.total())
            assert waits[0] > 0  # the first looks at the range of the opacities
            assert not any(waits[1:])
            assert "dropped twice" in hook.problem()


def test_the_steps_of_a_network_beside_the_gaussians_are_not_theirs(rasterizer, model_class, monkeypatch):
    """As that of Deformable-3D-Gaussians, which has a method of the same name and renders nothing."""

    class Network:
        def update_learning_rate(self, iteration):
            return iteration

    monkeypatch.setattr(sys.modules["scene.gaussian_model"], "Network", Network, raising=False)
    models = ["scene.gaussian_model:GaussianModel", "scene.gaussian_model:Network"]
    model, network, render = model_class(), Network(), make_render(rasterizer)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, models=models) as hook:
        for step in range(1, 5):
            model.update_learning_rate(step)
            render(model.camera, model, PIPE, BLACK)
            assert network.update_learning_rate(step) == step
    assert (hook.tally.regularized, hook.tally.lost) == (4, 0)


def test_opacities_decay_after_the_steps_of_every_model(rasterizer):
    """Also with the new parameters of a densification; whatever else is trained stays."""
    models = Model(), Model()
    optimizers = [optimizer_of(model) for model in models]
    for group in (group for optimizer in optimizers for group in optimizer.param_groups):
        group["lr"] = 0.0
    before = [x.detach().clone() for x in models[0].parameters()]
    render = make_render(rasterizer)
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=OpacityDecay(0.9, start=1)) as hook:
        for step in (1, 2, 3):
            hook.step(step)
            for model, optimizer in zip(models, optimizers, strict=True):
                train(model, render, optimizer)
            densify(models[0], optimizers[0])
    for model in models:
        for x, start in zip(model.parameters(), before, strict=True):
            if x.shape[1:] == (1,):
                torch.testing.assert_close(x.detach().sigmoid(), 0.81 * start.sigmoid(), rtol=1e-5, atol=0)
            else:
                assert torch.equal(x, start)
    assert hook.tally.decayed == 4


def test_a_resumed_training_decays_from_its_own_step_on(rasterizer, model_class):
    model = model_class()
    optimizer = optimizer_of(model)
    before, decay = model.get_opacity.detach().clone(), OpacityDecay(0.9, start=702)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=decay) as hook:
        for step in range(701, 706):
            model.update_learning_rate(step)
            train(model, make_render(rasterizer), optimizer)
    torch.testing.assert_close(model.get_opacity.detach(), before * 0.9**3)
    assert hook.tally.decayed == 3


class Twice(torch.optim.Adam):
    """Torch tells its hooks of a step of this class twice."""

    def step(self, closure=None):
        return super().step(closure)


def test_the_step_of_a_subclass_decays_once(rasterizer):
    model = Model()
    torch.optim.Adam([nn.Parameter(torch.zeros(1))])
    optimizer = optimizer_of(model, kind=Twice)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    before = model.get_opacity.detach().clone()
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=OpacityDecay(0.9, start=0)) as hook:
        for step in (1, 2):
            hook.step(step)
            train(model, make_render(rasterizer), optimizer)
    torch.testing.assert_close(model.get_opacity.detach(), before * 0.81)


def test_a_decay_of_opacities_that_are_not_rendered_is_an_error(rasterizer):
    """As in Scaffold-GS, whose group of that name is not what its network makes opacities of."""
    model, unused = Model(), nn.Parameter(torch.zeros(5, 1))
    optimizer = torch.optim.Adam([
        {"params": [unused], "name": "opacity"}, {"params": [*model.parameters()], "name": "mlp_opacity", "lr": 0.0},
    ])  # fmt: skip
    decay = OpacityDecay(0.9, start=0)
    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=decay, patience=2).install()
    for step in (1, 2):
        hook.step(step)
        train(model, make_render(rasterizer), optimizer)
    assert not unused.any()
    hook.step(3)
    with pytest.raises(RuntimeError, match="no parameter group"):
        train(model, make_render(rasterizer), optimizer)
    hook.uninstall()


def test_a_decay_that_never_begins_is_an_error(rasterizer):
    model = Model()
    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=OpacityDecay(start=1))
    with hook:
        for step in (1, 2):
            hook.step(step)
            train(model, make_render(rasterizer), optimizer_of(model))
            assert (hook.problem() is None) == (step == 2)


def test_a_render_without_gaussians_is_no_second_dropout(rasterizer):
    model = Model()
    for name in ("_xyz", "_scaling", "_rotation", "_opacity", "_features"):
        setattr(model, name, nn.Parameter(getattr(model, name).detach()[:0]))
    with RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer) as hook:
        hook.step(1)
        make_render(rasterizer)(model.camera, model, PIPE, BLACK)
        assert hook.problem() is None


def test_a_decay_that_finds_no_opacities_is_an_error(rasterizer):
    model = Model()
    optimizer = optimizer_of(model, name="mine")
    hook = RasterizerHook(GaussianDropout(0.5), rasterizer=rasterizer, decay=OpacityDecay(), patience=2).install()
    for step in (1, 2):
        hook.step(step)
        train(model, make_render(rasterizer), optimizer)
    assert re.search("not decay.* named opacity", hook.problem())
    hook.step(3)
    with pytest.raises(RuntimeError, match=r"not decay.* opacity"):
        train(model, make_render(rasterizer), optimizer)
    hook.uninstall()
