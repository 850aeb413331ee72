import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.studies import run as run_module
from reference_trainer.training.determinism import deterministic


def test_one_thread_and_afterwards_as_before():
    torch.set_num_threads(2)
    try:
        with deterministic():
            assert torch.get_num_threads() == 1
            assert not torch.are_deterministic_algorithms_enabled()  # nothing to choose on a CPU
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


def test_the_algorithms_of_cuda(monkeypatch):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", "")  # to be put back as it was
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG")
    with deterministic("cuda"):
        assert torch.are_deterministic_algorithms_enabled()
        assert not torch.utils.deterministic.fill_uninitialized_memory
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
    assert not torch.are_deterministic_algorithms_enabled()
    assert torch.utils.deterministic.fill_uninitialized_memory


def test_the_option_of_the_command(monkeypatch, tmp_path):
    seen = []

    def stop(*args, **keywords):
        seen.append(torch.get_num_threads())
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "run_experiment", stop)
    torch.set_num_threads(2)
    try:
        for option in ([], ["--deterministic"]):
            with pytest.raises(SystemExit):
                main(["train", "--out", str(tmp_path / "run"), *option])
    finally:
        torch.set_num_threads(1)
    assert seen == [2, 1]


_RUN = """
import hashlib, sys, torch
from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.determinism import deterministic
from reference_trainer.training.trainer import Trainer

torch.set_num_threads(int(sys.argv[1]))
config = TrainConfig(iterations=12, dropout=0.2, noise=0.4, densify_from=2, densify_every=4, densify_gradient=1e-4)
with deterministic():
    trainer = Trainer(synthetic_scene(width=64, height=48, points=2000), config)
    trainer.train()
print(hashlib.sha256(b"".join(x.detach().numpy().tobytes() for _, x in trainer.gaussians.named())).hexdigest())
"""


@pytest.mark.slow
def test_processes_agree_whatever_their_threads_and_hash_seeds():
    def result(threads: int, hash_seed: str) -> str:
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": str(threads)}
        command = [sys.executable, "-c", _RUN, str(threads)]
        root = Path(__file__).parents[3]
        return subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True).stdout

    assert result(1, "0") == result(4, "1") != ""
