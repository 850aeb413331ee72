"""The harness must see what it looks for: readers that do wrong on purpose."""

import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from fuzz import samples
from fuzz.harness import Target, fuzz
from fuzz.mutations import damage

GOOD = b'{"numbers": [1.0, 2.0, 3.0], "name": "good"}' * 20


def numbers(folder):
    return np.frombuffer((folder / "file").read_bytes(), np.uint8)


def target(read, **options):
    return Target("a reader", "file", lambda folder: (folder / "file").write_bytes(GOOD), read, "text", **options)


def only_good(wrong):
    """Read the good file, and do something wrong with any other."""
    return lambda folder: numbers(folder) if (folder / "file").read_bytes() == GOOD else wrong(folder)


def refuse(error):
    def raise_it(folder):
        raise error

    return raise_it


def keep_memory(folder):
    bytearray(20_000_000)
    raise ValueError(f"{folder}")


def busy(folder):
    end = time.process_time() + 1.1
    while time.process_time() < end:
        pass
    raise ValueError(f"{folder}")


@pytest.mark.parametrize(
    ("wrong", "inputs", "said"),
    [
        (refuse(KeyError("x")), 9, "KeyError"),
        (refuse(ValueError("damaged")), 9, "ValueError without the path"),
        (keep_memory, 9, "took more than 10 x its size in memory"),
        (busy, 1, "took 1 s"),
        (lambda folder: [float("nan")], 9, "values that are not finite"),
        (
            lambda folder: subprocess.run([sys.executable, "--version"], capture_output=True),
            1,
            "started another program (subprocess.Popen)",
        ),
    ],
)
def test_what_is_wrong_is_reported(tmp_path, wrong, inputs, said):
    outcome = fuzz(target(only_good(wrong)), tmp_path, range(inputs))
    found = {seed for seed, text in outcome.defects if text.endswith(said)}
    assert len(found) >= 0.7 * inputs  # now and then damage changes nothing


def test_half_a_file_is_reported(tmp_path):
    defects = fuzz(target(numbers), tmp_path, range(100)).defects
    assert defects
    assert {text.partition(":")[0] for _, text in defects} == {"cut", "foreign"}
    # A format with checksums may not be read wrongly at all.
    assert len(fuzz(target(numbers, checksummed=True), tmp_path, range(100)).defects) > len(defects)


def test_shapes_are_checked(tmp_path):
    def whole(array):
        assert len(array) == len(GOOD), "too short"

    kinds = fuzz(target(numbers, check=whole), tmp_path, range(100)).kinds()
    assert kinds["cut: inconsistent: too short"] > 0


@pytest.mark.parametrize("form", ["binary", "text", "json"])
def test_damage_depends_on_the_seed_alone(form):
    good = GOOD[:44]
    assert [damage(good, form, seed) for seed in range(300)] == [damage(good, form, seed) for seed in range(300)]
    assert sum(damage(good, form, seed)[1] != good for seed in range(300)) > 270


@pytest.mark.slow
def test_a_damaged_state_is_an_intact_file_and_depends_on_the_seed_alone(tmp_path):
    samples.write_trainer(tmp_path)
    good = (tmp_path / "checkpoint.pt").read_bytes()
    found = [damage(good, "state", seed)[1] for seed in range(60)]
    assert found == [damage(good, "state", seed)[1] for seed in range(60)]
    assert len(set(found)) > 50
    for data in found:
        (tmp_path / "checkpoint.pt").write_bytes(data)
        torch.load(tmp_path / "checkpoint.pt", weights_only=True)
