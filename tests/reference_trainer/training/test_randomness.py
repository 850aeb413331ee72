"""Random streams, and computing without any other chance."""

import dataclasses
import os
import subprocess
import sys
from contextlib import nullcontext
from itertools import product
from pathlib import Path

import pytest
import torch
from stand_ins.card import pretended_card

from reference_trainer.cli import main
from reference_trainer.runs import run as run_module
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.randomness import deterministic, stream, view_order
from reference_trainer.training.trainer import Trainer


def test_streams_repeat_and_differ_in_seed_step_and_purpose():
    keys = list(product((0, 1), (0, 1, 256), ("dropout", "noise", "split")))
    draws = [tuple(torch.rand(4, generator=stream(*key)).tolist()) for key in keys]
    assert draws == [tuple(torch.rand(4, generator=stream(*key)).tolist()) for key in keys]
    assert len(set(draws)) == len(keys)


def test_large_seeds_are_not_cut():
    seeds = [7, 2**32 + 7, 2**63 + 7]
    assert len({torch.rand(4, generator=stream(seed, 0, "a")).sum().item() for seed in seeds}) == 3


def test_neighboring_streams_are_independent():
    """Masks of neighboring steps overlap as chance has it.

    The share of 200 x 500 pairs that agree has mean 1/2 and standard deviation 0.0016; 5 of them: false alarm 6e-7.
    """
    masks = torch.stack([torch.rand(500, generator=stream(0, step, "dropout")) < 0.5 for step in range(201)])
    agree = (masks[1:] == masks[:-1]).double().mean().item()
    assert abs(agree - 0.5) < 5 * 0.5 / (200 * 500) ** 0.5


def test_the_global_generator_is_untouched():
    before = torch.get_rng_state()
    torch.rand(3, generator=stream(0, 0, "dropout"))
    view_order(0, 5, 3)
    assert torch.equal(torch.get_rng_state(), before)


def test_every_epoch_sees_every_view_in_an_order_of_its_own():
    epochs = [tuple(view_order(3, 5 * epoch + i, 5) for i in range(5)) for epoch in range(40)]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4] for epoch in epochs)
    # 40 orders of 120: fewer than 20 different ones is beyond any chance.
    assert len(set(epochs)) >= 20
    assert epochs != [tuple(view_order(4, 5 * epoch + i, 5) for i in range(5)) for epoch in range(40)]


def test_views_whose_names_are_not_utf_8_have_streams_of_their_own():
    """As files of old archives: the term ``views`` draws by the names of photographs."""
    names = [name.decode(errors="surrogateescape") for name in (b"\xe9.jpg", b"\xe8.jpg", b"e.jpg")]
    draws = [torch.rand(3, generator=stream(0, 1, f"{name}/regularizer")) for name in names]
    assert len({tuple(draw.tolist()) for draw in draws}) == 3


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


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_warnings_in_the_place_of_errors_are_as_before(monkeypatch, device):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        with deterministic(device):
            assert torch.is_deterministic_algorithms_warn_only_enabled() == (device == "cpu")
        assert torch.are_deterministic_algorithms_enabled()
        assert torch.is_deterministic_algorithms_warn_only_enabled()
    finally:
        torch.use_deterministic_algorithms(False)


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


def test_gsplat_cannot_repeat_itself(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["train", "--out", str(tmp_path / "run"), "--deterministic", "--renderer", "gsplat"])
    assert "--deterministic needs this package" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def trained_on_a_card(scene: Scene, config: TrainConfig, order: int, *, repeatable: bool) -> dict[str, torch.Tensor]:
    """Parameters after a training on a card that adds in an order of its own where it may."""
    with pretended_card(order=order) as card, deterministic(card) if repeatable else nullcontext():
        trainer = Trainer(scene, config, card)
        trainer.train()
        return {name: x.detach().cpu() for name, x in trainer.gaussians.named()}


@pytest.mark.slow
@pytest.mark.parametrize("change", [{}, {"analytic": True, "iterations": 8}], ids=["sampled", "analytic"])
def test_on_a_card_the_order_of_additions_does_not_matter(tiny_scene, busy, change):
    """Nor does anything that happens in training lack an algorithm that repeats itself: the card refuses that."""
    config = dataclasses.replace(busy, **{"iterations": 14, **change})
    one, other = (trained_on_a_card(tiny_scene, config, order, repeatable=True) for order in (0, 1))
    assert all(torch.equal(x, other[name]) for name, x in one.items())


@pytest.mark.slow
def test_on_a_card_it_matters_without(tiny_scene, busy):
    config = dataclasses.replace(busy, iterations=6)
    one, other = (trained_on_a_card(tiny_scene, config, order, repeatable=False) for order in (0, 1))
    assert not all(torch.equal(x, other[name]) for name, x in one.items())  # which ones differ depends on the processor


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda_training_repeats_itself_bit_for_bit(tiny_scene, busy):
    with deterministic("cuda"):
        one, other = (Trainer(tiny_scene, busy, "cuda") for _ in range(2))
        one.train()
        other.train()
    assert len(one.gaussians) == len(other.gaussians)
    for (name, x), (_, y) in zip(one.gaussians.named(), other.gaussians.named(), strict=True):
        assert torch.equal(x, y), name


_RUN = """
import hashlib, sys, torch
from reference_trainer.scenes import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.randomness import deterministic
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
