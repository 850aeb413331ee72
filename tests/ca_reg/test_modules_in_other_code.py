"""The modules inside what other people do with modules: state dicts, averages, torch.compile, recomputation."""

import copy
import io
import pickle

import pytest
import torch
from stand_ins.card import counted_synchronizations
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.checkpoint import checkpoint

from ca_reg import CAPenalty, Chain, GaussianDropout, OpacityNoise, Params
from ca_reg.functional import Multiplier
from ca_reg.regularizers import parse
from ca_reg.regularizers.clustered import SHDropout
from ca_reg.schedules import LinearRamp

OPACITY = torch.linspace(0.05, 0.95, 40)
RAMP = LinearRamp(0.0, 0.5, 0, 100)


def penalty(weight):
    def moments(opacity, view, multiplier, background):
        both = {"mean": multiplier.mean * opacity[0], "variance": multiplier.variance * opacity[0] ** 2}  # of one splat
        return {name: x.expand(3, 4, 5) for name, x in both.items()}

    return CAPenalty(moments, Multiplier.dropout(0.3), weight=weight)


KINDS = {"dropout": GaussianDropout, "noise": OpacityNoise, "penalty": penalty}
each_kind = pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)


def seeded():
    return torch.Generator().manual_seed(0)


def model(*regularizers):
    return nn.Sequential(nn.Linear(3, 2), *regularizers)


# --- copies ---


class Half(nn.Module):
    """Knows nothing of this package; what it returns is part of the graph of a step."""

    def forward(self, opacity, generator=None):
        return 0.5 * opacity


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda module: pickle.loads(pickle.dumps(module))])
def test_a_module_can_be_copied_between_a_render_and_its_backward_pass(copied):
    logits = torch.zeros(40, requires_grad=True)
    chain = Chain(GaussianDropout(0.5), Half())
    out = chain(logits.sigmoid())
    twin = copied(chain)
    assert twin.keep is None
    assert torch.equal(twin(OPACITY, generator=seeded()), chain(OPACITY, generator=seeded()))
    out.sum().backward()
    assert logits.grad.any()


# --- state dicts ---


@each_kind
@pytest.mark.parametrize("rate", [0.2, RAMP], ids=["constant", "schedule"])
def test_a_strict_checkpoint_from_before_the_module_was_added_loads(make, rate):
    former, present = model(), model(make(rate))
    present[1].set_step(30)
    present.load_state_dict(former.state_dict(), strict=True)
    assert torch.equal(present[0].weight, former[0].weight)
    assert present[1].step == 30


@each_kind
def test_a_constant_rate_leaves_no_trace_in_the_state(make):
    assert make(0.2).state_dict() == {}


@each_kind
def test_the_step_of_a_schedule_survives_a_checkpoint_on_disk(make):
    saved, loaded = make(RAMP), make(RAMP)
    saved.set_step(70)
    file = io.BytesIO()
    torch.save(saved.state_dict(), file)
    file.seek(0)
    loaded.load_state_dict(torch.load(file, weights_only=True), strict=True)
    assert loaded.step == 70
    assert repr(loaded) == repr(saved)


@each_kind
@pytest.mark.parametrize("rate", [0.2, RAMP], ids=["constant", "schedule"])
def test_a_moving_average_over_the_values_of_a_state(make, rate):
    present = model(make(rate))
    average = copy.deepcopy(present)
    state = average.state_dict()
    for step in (10, 20):
        present[1].set_step(step)
        for name, value in present.state_dict().items():
            state[name].mul_(0.5).add_(value, alpha=0.5)
    average.load_state_dict(state, strict=True)
    assert average[1].step == (0 if rate == 0.2 else 12)  # (0 / 2 + 10 / 2) / 2 + 20 / 2, to the nearest even


@pytest.mark.parametrize("wrap", [Chain, lambda *parts: nn.Sequential(Chain(*parts))], ids=["alone", "within"])
@pytest.mark.parametrize("rate", [0.2, RAMP], ids=["constant", "schedule"])
def test_a_chain_goes_back_to_the_step_of_an_earlier_checkpoint(wrap, rate):
    module = wrap(GaussianDropout(RAMP), OpacityNoise(rate), nn.Sequential(nn.Identity(), Half()))
    chain = module if isinstance(module, Chain) else module[0]
    chain.set_step(40)
    earlier = copy.deepcopy(module.state_dict())
    chain.set_step(100)
    module.load_state_dict(earlier)
    assert chain.step == 40
    chain.eval()
    assert torch.equal(chain(OPACITY), OPACITY * (1 - RAMP(40)) * 0.5)


def test_an_unknown_entry_is_still_refused():
    with pytest.raises(RuntimeError, match="Unexpected key"):
        GaussianDropout(RAMP).load_state_dict({"rate": torch.tensor(0.1)})


# --- torch.compile; the graphs are traced and run as they are, which takes no compiler ---


class Counting:
    """A backend that counts the graphs."""

    def __init__(self):
        self.graphs = 0

    def __call__(self, graph, inputs):
        self.graphs += 1
        return graph.forward


CALLS = {
    "dropout": (GaussianDropout, {}, True),
    "compensated dropout": (GaussianDropout, {"compensate": True}, True),
    "noise": (OpacityNoise, {"clip": True}, True),
    "dropout in evaluation": (GaussianDropout, {}, False),
    "noise in evaluation": (OpacityNoise, {}, False),
    "two in evaluation": (lambda rate: Chain(GaussianDropout(0.1), GaussianDropout(rate)), {}, False),
}


@pytest.mark.slow  # loads torch's tracer
@pytest.mark.parametrize("rate", [0.2, RAMP], ids=["constant", "schedule"])
@pytest.mark.parametrize(("make", "arguments", "training"), CALLS.values(), ids=CALLS)
def test_one_graph_serves_all_steps_and_does_what_the_module_does(make, arguments, training, rate):
    torch._dynamo.reset()
    module, backend = make(rate, **arguments).train(training), Counting()
    module.set_step(0)
    compiled = torch.compile(module, backend=backend, fullgraph=True)
    for step in range(1, 21):
        module.set_step(step)
        torch.manual_seed(step)
        found = compiled(OPACITY)
        torch.manual_seed(step)
        torch.testing.assert_close(found, module(OPACITY), rtol=1e-6, atol=0.0)
    assert backend.graphs <= 1  # none, where there is nothing to do


@pytest.mark.slow  # loads torch's tracer
@pytest.mark.parametrize("dynamic", [None, True], ids=["found out", "asked for"])
@pytest.mark.parametrize(
    "module", [GaussianDropout(0.2), OpacityNoise(0.8), Chain(GaussianDropout(RAMP))], ids=["dropout", "noise", "chain"]
)
def test_a_compiled_module_serves_gaussians_whose_number_changes(module, dynamic):
    """Densification changes it; the first change may take a second graph, one for any number."""
    torch._dynamo.reset()
    backend = Counting()
    module.set_step(20)
    compiled = torch.compile(module, backend=backend, fullgraph=True, dynamic=dynamic)
    for count in (9, 10, 7, 30, 31):
        torch.manual_seed(count)
        found = compiled(torch.full((count,), 0.5))
        torch.manual_seed(count)
        torch.testing.assert_close(found, module(torch.full((count,), 0.5)), rtol=1e-6, atol=0.0)
    assert backend.graphs <= 2


@pytest.mark.slow  # loads torch's tracer
def test_one_graph_serves_all_weights_of_a_penalty():
    torch._dynamo.reset()
    module, backend = penalty(RAMP), Counting()
    module.set_step(0)
    compiled = torch.compile(module, backend=backend, fullgraph=True)
    for step in range(1, 21):
        module.set_step(step)
        torch.testing.assert_close(compiled(OPACITY, None).penalty, module(OPACITY, None).penalty)
    assert backend.graphs == 1


@pytest.mark.slow  # compiles
def test_a_compiled_schedule_drops_at_its_rate():
    """Through the whole compiler, whose random numbers are its own; two rates from one graph."""
    torch._dynamo.reset()
    module = GaussianDropout(LinearRamp(0.2, 0.6, 0, 100))
    module.set_step(0)
    compiled = torch.compile(module, fullgraph=True)
    opacity = torch.full((40_000,), 0.5)
    for step, rate in ((0, 0.2), (50, 0.4), (100, 0.6)):
        module.set_step(step)
        try:
            dropped = (compiled(opacity) == 0).double().mean().item()
        except Exception as error:  # whatever this machine's compiler, or its absence, raises
            if "compiler" in str(error).lower():
                pytest.skip(f"no compiler works here: {error}")
            raise
        # 5 standard deviations of a mean of 40,000 Bernoulli numbers: false alarm 6e-7 each.
        assert abs(dropped - rate) < 5 * 0.5 / 200


# --- CUDA graphs ---

GRAPHED = pytest.mark.parametrize(
    "text", ["dropout(0.3)", "dropout(0.3, compensate=True)", "dropout(0.3) + noise(0.8)"]
)


@pytest.fixture
def capture(monkeypatch):
    for asked in ("is_initialized", "is_current_stream_capturing"):
        monkeypatch.setattr(torch.cuda, asked, lambda: True)


class OnTheProcessor(TorchDispatchMode):
    """Keeps the operations with a tensor of the processor, which a capture refuses."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        devices = [x.device for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        if torch.device("cpu") in [*devices, kwargs.get("device")]:
            self.found.append(operation)
        return operation(*args, **kwargs)


@GRAPHED
def test_a_capture_neither_waits_for_the_card_nor_copies_to_it(card, capture, text):
    """Not even in the first call."""
    opacity = OPACITY.to(card).requires_grad_()
    with counted_synchronizations() as waits, OnTheProcessor() as operations:
        parse(text)(opacity)
    assert not waits
    assert not operations.found


def test_a_graph_that_would_keep_the_rate_of_its_capture_is_refused(capture):
    module = GaussianDropout(RAMP)
    module.set_step(50)
    with pytest.raises(RuntimeError, match=r"keep p .*captured.*LinearRamp"):
        module(OPACITY)


def test_a_graph_that_would_keep_the_degree_of_its_capture_is_refused(capture):
    module, x = SHDropout(0.2, until=(20, 40)), Params(OPACITY, sh=torch.ones(40, 16, 3))
    with pytest.raises(RuntimeError, match=r"degree 1 .*step 30 .*captured.*\(20, 40\)"):
        module(x._replace(step=30))
    last = x._replace(step=40)  # nothing is dropped any more, at no later step either
    assert module(last) is last


@pytest.mark.parametrize("text", ["position_noise(0.1)", "density", "clustered(0.2)"])
def test_a_graph_that_would_keep_the_neighbors_of_its_capture_is_refused(request, text):
    module, x = parse(text), Params(OPACITY, means=torch.rand(40, 3), step=30)
    module(x)  # the neighbors are known by now
    request.getfixturevalue("capture")
    with pytest.raises(RuntimeError, match=r"surrounds the Gaussians .*captured"):
        module(x._replace(step=31))


@pytest.mark.gpu
@GRAPHED
def test_a_cuda_graph_draws_anew_at_every_replay(text):
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    module, opacity = parse(text), torch.full((10_000, 1), 0.5, device="cuda", requires_grad=True)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        drawn = module(opacity)
        (gradient,) = torch.autograd.grad(drawn.sum(), opacity)
    keep, replays = module.keep, []
    for _ in range(2):
        graph.replay()
        replays.append([x.clone() for x in (drawn.detach(), gradient, keep)])
    assert not torch.equal(replays[0][0], replays[1][0])
    for values, slopes, kept in replays:
        assert not values[~kept].any()
        assert not slopes[~kept].any()
        # 5 standard deviations of a mean of 10,000 Bernoulli numbers: false alarm 6e-7 each.
        assert abs(kept.float().mean().item() - 0.7) < 5 * 0.5 / 100


# --- recomputation ---


@pytest.mark.parametrize("reentrant", [False, True])
@pytest.mark.parametrize("module", [GaussianDropout(0.5), OpacityNoise(0.3)], ids=["dropout", "noise"])
def test_recomputation_repeats_the_draw_or_refuses(module, reentrant):
    def gradient(**arguments):
        x = OPACITY.clone().requires_grad_()
        torch.manual_seed(3)
        checkpoint(lambda o: module(o, **arguments).square().sum(), x, use_reentrant=reentrant).backward()
        return x.grad

    x = OPACITY.clone().requires_grad_()
    torch.manual_seed(3)
    module(x).square().sum().backward()
    draw = {"drawn": module.last}
    assert torch.equal(gradient(), x.grad)
    assert torch.equal(gradient(**draw), x.grad)
    with pytest.raises(RuntimeError, match=r"generator=.*torch\.utils\.checkpoint.*drawn="):
        gradient(generator=torch.Generator().manual_seed(3))
