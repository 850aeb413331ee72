"""What all hooks share: regularizers in the mode of the call, and one rule for what was dropped."""

import sys
import threading

import pytest
import torch
from stand_ins.inria import PIPE, Model, make_rasterizer, make_render
from torch import nn

from ca_reg import Draw, GaussianDropout, OpacityNoise, Regularizer
from ca_reg.integrations.gsplat import regularized
from ca_reg.integrations.inria import RasterizerHook

N = 60
OPACITY = torch.full((N,), 0.8)


def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
    """As much of gsplat 1.4 as the adapter sees: the radii do not follow from the opacities."""
    return opacities, opacities, {"radii": torch.ones(1, len(opacities), dtype=torch.int32), "gaussian_ids": None}


def call(wrapped, opacities):
    return wrapped(None, None, None, opacities, None, None, None, 8, 8)


class DropEverySecond(Regularizer):
    """A user's own regularizer, by the base class."""

    def draw(self, x, generator=None):
        return Draw(keep=torch.arange(len(x.opacities)) % 2 == 0)

    def replay(self, x, draw):
        return x._replace(opacities=x.opacities * draw.keep)


class ZeroEverySecond(nn.Module):
    """A module that has never heard of the project."""

    def forward(self, opacity, **options):
        return opacity * (torch.arange(len(opacity)) % 2 == 0).view(-1, *[1] * (opacity.ndim - 1))


@pytest.mark.parametrize("make", [DropEverySecond, ZeroEverySecond])
@pytest.mark.parametrize("chained", [False, True])
def test_every_hook_hides_what_any_module_drops(make, chained):
    regularizer = nn.Sequential(OpacityNoise(0.1), nn.Sequential(make())) if chained else make()
    even = torch.arange(N) % 2 == 0
    radii = call(regularized(rasterization, regularizer), OPACITY.clone().requires_grad_())[2]["radii"]
    assert torch.equal(radii[0] > 0, even)

    rasterizer, model = make_rasterizer(), Model(N)
    plain = make_render(rasterizer)(model.camera, model, PIPE, torch.zeros(3))["radii"]
    with RasterizerHook(regularizer, rasterizer=rasterizer) as hook:
        hook.step(1)
        radii = make_render(rasterizer)(model.camera, model, PIPE, torch.zeros(3))["radii"]
    assert torch.equal(radii, plain * even)


def test_what_noise_clamps_to_zero_is_seen_all_the_same_in_every_hook():
    """As in the paper's code, whose noise leaves the radii alone."""
    noise = OpacityNoise(2.0)
    torch.manual_seed(0)
    image, _, info = call(regularized(rasterization, noise), OPACITY.clone().requires_grad_())
    assert (image == 0).any()
    assert info["radii"].all()

    rasterizer, model = make_rasterizer(), Model(N)
    plain = make_render(rasterizer)(model.camera, model, PIPE, torch.zeros(3))["radii"]
    with RasterizerHook(noise, rasterizer=rasterizer) as hook:
        hook.step(1)
        assert torch.equal(make_render(rasterizer)(model.camera, model, PIPE, torch.zeros(3))["radii"], plain)
    assert (noise.noise < -1).any()


def test_a_test_render_shares_the_tensors_and_nothing_else():
    class Learned(nn.Module):
        def __init__(self):
            super().__init__()
            self.factor = nn.Parameter(torch.tensor(0.5))
            self.dropout = GaussianDropout(0.2)

        def forward(self, opacity):
            return self.dropout(opacity) * self.factor

    module = Learned()
    wrapped = regularized(rasterization, module)
    call(wrapped, OPACITY.clone().requires_grad_())
    keep = module.dropout.keep
    opacity = wrapped.evaluate(None, None, None, OPACITY, None, None, None, 8, 8)[0]
    torch.testing.assert_close(opacity, torch.full((N,), 0.32))
    opacity.sum().backward()
    assert module.factor.grad == pytest.approx(N * 0.64)
    assert module.dropout.keep is keep
    assert (module.training, module.dropout.training, module.dropout.step) == (True, True, 0)


def test_a_compiled_module_evaluates_too():
    compiled = torch.compile(GaussianDropout(0.25), backend="eager")
    with torch.no_grad():
        torch.testing.assert_close(call(regularized(rasterization, compiled), OPACITY)[0], 0.75 * OPACITY)


def test_a_module_that_was_in_eval_when_it_was_wrapped_trains_all_the_same():
    module = ZeroEverySecond().eval()
    wrapped = regularized(rasterization, module)
    module.train()
    info = call(wrapped, OPACITY.clone().requires_grad_())[2]
    assert torch.equal(info["radii"][0] > 0, torch.arange(N) % 2 == 0)


def test_an_exception_at_any_line_leaves_the_mode_alone():
    """As nerfview does, which interrupts a render through `sys.settrace`."""
    dropout = GaussianDropout(0.5)
    wrapped = regularized(rasterization, dropout)

    def interrupted_at(line):
        """Raise at the so many-th line that the adapter runs; return whether there was one."""
        left = line

        def trace(frame, event, argument):
            nonlocal left
            if not frame.f_code.co_filename.endswith(("gsplat.py", "_call.py", "chain.py", "contextlib.py")):
                return None
            if event == "line":
                left -= 1
                if left < 0:
                    raise KeyboardInterrupt
            return trace

        with torch.no_grad():
            before = sys.gettrace()
            sys.settrace(trace)
            try:
                call(wrapped, OPACITY)
            except KeyboardInterrupt:
                return True
            finally:
                sys.settrace(before)
        return False

    line = 0
    while interrupted_at(line):
        assert dropout.training, f"eval() stayed behind after an exception at line {line}"
        line += 1
    assert line > 10


def test_a_training_call_during_an_evaluation_in_another_thread_is_regularized():
    inside, done = threading.Event(), threading.Event()

    class Slow(GaussianDropout):
        def expected(self, x):
            inside.set()
            assert done.wait(timeout=30)
            return super().expected(x)

    wrapped = regularized(rasterization, Slow(0.5))
    seen = []

    def view():
        with torch.no_grad():
            seen.append(call(wrapped, OPACITY)[0])

    thread = threading.Thread(target=view)
    thread.start()
    assert inside.wait(timeout=30)
    image, _, info = call(wrapped, OPACITY.clone().requires_grad_())
    done.set()
    thread.join()
    assert (image == 0).any()
    assert torch.equal(info["radii"][0] > 0, image > 0)
    torch.testing.assert_close(seen[0], 0.5 * OPACITY)
    assert wrapped.tally.regularized == 1
