"""Code that says "cuda", on a machine without."""

import importlib
import re
import sys
import threading
from pathlib import Path

import pytest
import torch
from floors import sources
from torch._inductor.codecache import CacheBase

from reference_trainer.compat.cuda import cuda_on_cpu

without_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="with a CUDA device nothing is mapped")
CUDA = torch.device("cuda:0")
ROOT = Path(__file__).resolve().parents[3]


@without_cuda
@pytest.mark.parametrize(
    "make",
    [
        lambda: torch.zeros(2, 3, device="cuda"),
        lambda: torch.tensor([1.0], device="cuda:0"),
        lambda: torch.rand(3, device=CUDA),
        lambda: torch.zeros_like(torch.ones(2), dtype=torch.float32, requires_grad=True, device="cuda"),
        lambda: torch.ones(2).new_zeros(3, device="cuda"),
        lambda: torch.ones(2).cuda(),
        lambda: torch.ones(2).cuda(0, non_blocking=True),
        lambda: torch.ones(2).to("cuda"),
        lambda: torch.ones(2).to(CUDA, torch.float64),
        lambda: torch.ones(2).to(device="cuda", dtype=torch.float64),
        lambda: torch.nn.Linear(2, 2).cuda().weight,
        lambda: torch.nn.Linear(2, 2).to("cuda").weight,
        lambda: torch.nn.Linear(2, 2, device="cuda").weight,
        lambda: torch.nn.Parameter(torch.ones(2).cuda().requires_grad_(True)),
        lambda: torch.Generator("cuda"),
        lambda: torch.Generator(device=CUDA),
    ],
)
def test_cuda_means_the_cpu_within_the_block_only(make):
    with cuda_on_cpu():
        assert make().device.type == "cpu"
    with pytest.raises((RuntimeError, AssertionError)):
        make()


@without_cuda
def test_other_arguments_are_left_alone(generator):
    state = generator.get_state()
    with cuda_on_cpu():
        assert isinstance(generator, torch.Generator)
        assert isinstance(torch.Generator().manual_seed(1), type(generator))
        drawn = torch.rand(4, generator=generator)
        assert torch.zeros(2, dtype=torch.float64, device="meta").device.type == "meta"
        assert torch.einsum("ij,j->i", torch.eye(2), torch.ones(2)).tolist() == [1, 1]
    generator.set_state(state)
    assert torch.equal(drawn, torch.rand(4, generator=generator))


@without_cuda
def test_torch_cuda_is_restored_also_after_an_error():
    before = {name: getattr(torch.cuda, name) for name in dir(torch.cuda)}

    def fail():
        with cuda_on_cpu():
            assert torch.cuda.Event is not before["Event"]
            raise KeyError("theirs")

    with pytest.raises(KeyError, match="theirs"):
        fail()
    assert {name: getattr(torch.cuda, name) for name in dir(torch.cuda)} == before


@without_cuda
def test_housekeeping_is_harmless():
    with cuda_on_cpu():
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        torch.cuda.set_device(torch.device("cuda:0"))
        start.record()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        torch.cuda.manual_seed_all(0)
        end.record()
        end.synchronize()
        end.wait()
        assert end.query()
        assert 0 <= start.elapsed_time(end) < 60_000
        assert torch.cuda.memory_allocated() == 0
        assert torch.zeros(1, device=torch.device("cuda", torch.cuda.current_device())).device.type == "cpu"
        assert not torch.cuda.is_available()


ANSWERS = {
    "Event": lambda: torch.cuda.Event().record(torch.cuda.current_stream()),
    "current_device": lambda: torch.ones(2, device=torch.cuda.current_device()),
    "current_stream": lambda: torch.cuda.current_stream(CUDA).record_event().synchronize(),
    "device_count": lambda: torch.cuda.device_count(),
    "device_of": lambda: torch.cuda.device_of(torch.ones(2, device="cuda")).__enter__(),
    "get_device_capability": lambda: torch.cuda.get_device_capability("cuda") >= (7, 5),
    "get_device_name": lambda: torch.cuda.get_device_name("cuda"),
    "get_device_properties": lambda: torch.cuda.get_device_properties("cuda").total_memory,
    "is_available": lambda: torch.cuda.is_available(),
    "is_current_stream_capturing": lambda: torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing(),
    "is_initialized": lambda: torch.cuda.is_initialized(),
    "synchronize": lambda: torch.cuda.synchronize("cuda"),
}
"""How the packages use what they use of `torch.cuda`."""


@without_cuda
def test_all_that_the_packages_ask_of_a_card_has_an_answer():
    asked = re.compile(r"\btorch\.cuda\.(\w+)")
    texts = [path.read_text("utf-8") for path in sources(ROOT).values()]
    assert {name for text in texts for name in asked.findall(text)} == ANSWERS.keys()
    with cuda_on_cpu():
        for answer in ANSWERS.values():
            answer()
        with torch.cuda.device(0):
            assert torch.ones(2, device="cuda").sum() == 2


@without_cuda
def test_no_stand_in_serves_two_names():
    # Dynamo, which optimizers import, keeps a table of torch's functions and fails on one object with two rules.
    before = vars(torch.cuda).copy()
    with cuda_on_cpu():
        replaced = [value for name, value in vars(torch.cuda).items() if value is not before.get(name)]
    assert len({id(value) for value in replaced}) == len(replaced) > 10


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_with_a_device_nothing_changes():
    before = torch.cuda.Event
    with cuda_on_cpu():
        assert torch.cuda.Event is before
        assert torch.zeros(1, device="cuda").is_cuda


@without_cuda
def test_a_file_of_a_card_is_loaded(tmp_path, monkeypatch):
    load = torch.load
    with monkeypatch.context() as card:
        card.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
        torch.save({"x": torch.ones(2)}, tmp_path / "x.pt")
    with pytest.raises(RuntimeError, match="CUDA"):
        torch.load(tmp_path / "x.pt", weights_only=True)
    with cuda_on_cpu():
        for place in ("cuda:0", CUDA, None):
            assert torch.load(tmp_path / "x.pt", map_location=place, weights_only=True)["x"].device.type == "cpu"
        assert torch.load(tmp_path / "x.pt", weights_only=True)["x"].tolist() == [1, 1]
    assert torch.load is load


@without_cuda
def test_threads_that_are_started_within_the_block_are_covered():
    start, found = threading.Thread.start, []
    with cuda_on_cpu():
        thread = threading.Thread(target=lambda: found.append(torch.zeros(2, device="cuda").device.type))
        thread.start()
        thread.join()
    assert found == ["cpu"]
    assert threading.Thread.start is start


@without_cuda
def test_what_scripts_ask_a_device_has_an_answer():
    with cuda_on_cpu():
        free, total = torch.cuda.mem_get_info()
        assert 0 < free <= total == torch.cuda.get_device_properties("cuda").total_memory
        assert CacheBase.get_system.__wrapped__()["hash"]  # which torch.compile wants to know before it compiles
        assert torch.cuda.get_device_name(0)
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side), torch.cuda.nvtx.range("a render"):
            torch.cuda.nvtx.range_push("colors")
            torch.cuda.nvtx.range_pop()
            assert torch.ones(2, device="cuda").sum() == 2
        side.synchronize()


@pytest.mark.parametrize("kernels", [False, True])
def test_a_torchvision_without_kernels_can_be_imported(tmp_path, monkeypatch, kernels):
    """As its wheels for CUDA are beside a torch without: registering operators that do not exist fails."""
    package = tmp_path / "torchvision"
    package.mkdir()
    (package / "__init__.py").write_text("from .extension import _has_ops\nfrom . import _meta_registrations\n")
    (package / "extension.py").write_text(f"def _has_ops():\n    return {kernels}\n")
    (package / "_meta_registrations.py").write_text(f"registered = True\nassert {kernels}, 'torchvision::nms'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    with cuda_on_cpu():
        module = importlib.import_module("torchvision")
        assert hasattr(module._meta_registrations, "registered") == kernels
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        del sys.modules[name]
