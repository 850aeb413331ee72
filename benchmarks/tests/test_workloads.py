"""The workloads against the shared benchmark's own generator."""

import importlib.util
import sys
import types

import numpy as np
import pytest
import torch
from oracles import brute_force

from benchmarks.workloads import WORKLOADS, Workload, WorkloadSpec, covered_pairs


@pytest.fixture
def bench(data_root, tmp_path, monkeypatch):
    """The generator of the shared benchmark, which writes into a temporary folder."""
    file = data_root.parent / "bench" / "workload.py"
    if not file.is_file():
        pytest.skip(f"the shared benchmark is not at {file}")
    monkeypatch.setenv("BENCH_OUT", str(tmp_path))
    spec = importlib.util.spec_from_file_location("bench_workload", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def as_workload(data, camera):
    names = {"means": "means", "quaternions": "quats", "scales": "scales", "opacities": "opacities", "colors": "colors"}
    tensors = {ours: torch.from_numpy(data[theirs]) for ours, theirs in names.items()}
    return Workload(**tensors, target=torch.from_numpy(data["target"]).permute(2, 0, 1), camera=camera)


@pytest.mark.data
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # of the shared script
def test_the_workloads_are_those_of_the_shared_benchmark(bench, monkeypatch):
    # It calibrates the scales by counting pairs in a compiled helper; here our own count decides, so this also tests
    # the calibrated numbers. Its reference images are not needed.
    def count(data):
        spec = next(x for x in WORKLOADS.values() if x.gaussians == data["N"])
        return covered_pairs(as_workload(data, spec.make().camera))

    helper = types.SimpleNamespace(count_pairs=count, render=lambda data: (np.zeros(1), {"T": np.zeros(1)}))
    monkeypatch.setitem(sys.modules, "reference", helper)
    bench.main()
    for name, spec in WORKLOADS.items():
        data = bench.load(name)
        ours = spec.make()
        theirs = as_workload(data, ours.camera)
        for key, tensor in {**ours.parameters, "target": ours.target}.items():
            assert torch.equal(tensor, getattr(theirs, key)), (name, key)
        camera, intrinsics = ours.camera, data["K"]
        assert torch.equal(camera.world_to_camera, torch.from_numpy(data["viewmat"]))
        assert np.array_equal([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], intrinsics)
        assert (camera.width, camera.height) == (data["W"], data["H"])


def test_the_camera_looks_at_the_cube_from_two_units_away():
    workload = WorkloadSpec(500, 32, 24, 0.05).make()
    pose = workload.camera.world_to_camera.double()
    assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-6)
    assert pose[:3, 3].tolist() == [0, 0, 2]
    assert float(workload.means.abs().max()) <= 0.5
    assert float(workload.scales.max() / workload.scales.min()) <= 9


def test_a_workload_moves_as_a_whole():
    moved = WorkloadSpec(5, 8, 8, 0.1).make().to(dtype=torch.float64)
    assert {x.dtype for x in (*moved.parameters.values(), moved.target, moved.camera.world_to_camera)} == {
        torch.float64
    }


def test_pairs_are_those_that_brute_force_renders():
    # Some ellipses reach beyond the picture, some lie outside.
    workload = WorkloadSpec(40, 30, 20, 0.02).make().to(dtype=torch.float64)
    rendered = [
        (brute_force(*(x[i : i + 1] for x in workload.parameters.values()), workload.camera)[1] > 0).sum().item()
        for i in range(40)
    ]
    assert covered_pairs(workload) == sum(rendered)
    assert min(rendered) == 0
