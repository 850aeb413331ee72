import gzip
import math
import struct
import sys

import numpy as np
import pytest
import torch

from reference_trainer.cli import main
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import load_ply, save_ply
from reference_trainer.runs.edit_ply import bake_ply, compress_ply


@pytest.fixture
def plain(tmp_path):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(6, 3, generator=generator)
    save_ply(Gaussians.from_points(points, points, torch.full((6,), 0.1), sh_degree=1, opacity=0.7), tmp_path / "a.ply")
    return tmp_path / "a.ply"


def test_only_the_opacities_change_and_a_comment_says_so(plain, tmp_path):
    bake_ply(plain, tmp_path / "b.ply", regularizer="dropout(0.3)")
    header, body = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")
    assert b"comment ca_reg opacity_scaled_by 0.7\n" in header
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    values = struct.unpack(f"<{6 * len(names)}f", body)
    logits = values[names.index("opacity") :: len(names)]
    assert [1 / (1 + math.exp(-x)) for x in logits] == pytest.approx([0.7 * 0.7] * 6, rel=1e-6)
    before, after = load_ply(plain).gaussians, load_ply(tmp_path / "b.ply").gaussians
    for (name, one), (_, other) in zip(before.named(), after.named(), strict=True):
        assert name == "opacity_logits" or torch.equal(one, other)


def test_nothing_is_scaled_twice_or_overwritten(plain, tmp_path):
    baked = tmp_path / "b.ply"
    bake_ply(plain, baked, regularizer="dropout(0.2)")
    with pytest.raises(ValueError, match=r"scaled by 0\.8 already"):
        bake_ply(baked, tmp_path / "c.ply", regularizer="dropout(0.2)")
    content = baked.read_bytes()
    with pytest.raises(FileExistsError, match="exists already"):
        bake_ply(plain, baked, regularizer="dropout(0.5)")
    assert baked.read_bytes() == content
    gaussians = load_ply(plain).gaussians
    save_ply(gaussians, tmp_path / "noise.ply", opacities=gaussians.opacities * 0.5)
    with pytest.raises(ValueError, match="the test already"):
        bake_ply(tmp_path / "noise.ply", tmp_path / "c.ply", regularizer="dropout(0.2)")
    assert not (tmp_path / "c.ply").exists()


@pytest.mark.parametrize(
    ("regularizer", "message"),
    [
        (None, "trained with: .*--regularizer"),
        ("dropout(1.0)", r"p must be in \[0, 1\)"),
        ("noise(0.8)", "nothing to bake"),
        ("dropout(0.2, compensate=True)", "is rendered as it is"),
    ],
)
def test_nothing_to_bake(plain, tmp_path, regularizer, message):
    with pytest.raises(ValueError, match=message):
        bake_ply(plain, tmp_path / "b.ply", regularizer=regularizer)
    assert not (tmp_path / "b.ply").exists()


def test_a_file_says_what_it_was_trained_with_but_nothing_is_imported_for_it(plain, tmp_path):
    gaussians = load_ply(plain).gaussians
    save_ply(gaussians, tmp_path / "a.ply", regularizer="noise(0.8, scale=True)", step=7)
    assert bake_ply(tmp_path / "a.ply", tmp_path / "b.ply") == "noise(0.8, scale=True)"
    assert load_ply(tmp_path / "b.ply").for_rendering
    save_ply(gaussians, tmp_path / "c.ply", regularizer="antigravity:Fly", step=7)
    with pytest.raises(ValueError, match=r"antigravity, .*not imported"):
        bake_ply(tmp_path / "c.ply", tmp_path / "d.ply")


@pytest.mark.parametrize("regularizer", ["dropout(0.3)", None])
def test_a_small_file_for_the_web(plain, tmp_path, regularizer):
    """Decoded by the layout that Niantic documents: a header of 16 bytes, positions of 3 x 24 bits, opacities of 8."""
    pytest.importorskip("gaussforge", reason="needs ca_reg[web]")
    compress_ply(plain, tmp_path / "a.spz", regularizer=regularizer)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, _, count, degree, fraction, _, _ = struct.unpack("<IIIBBBB", content[:16])
    assert (magic, count, degree) == (0x5053474E, 6, 1)
    body = np.frombuffer(content, np.uint8, offset=16)
    parts = body[: 9 * count].reshape(count, 3, 3).astype(int)
    fixed = parts[..., 0] + (parts[..., 1] << 8) + (parts[..., 2] << 16)
    positions = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / 2**fraction
    gaussians = load_ply(plain).gaussians
    assert np.abs(positions - gaussians.means.numpy()).max() <= 1 / 2**fraction
    opacity = 0.7 * (0.7 if regularizer else 1.0)
    assert body[9 * count : 10 * count] / 255 == pytest.approx([opacity] * 6, abs=1 / 255)
    with pytest.raises(FileExistsError, match="exists already"):
        compress_ply(plain, tmp_path / "a.spz")


def test_a_file_for_the_web_takes_a_baked_ply_as_it_is(plain, tmp_path):
    pytest.importorskip("gaussforge", reason="needs ca_reg[web]")
    bake_ply(plain, tmp_path / "b.ply", regularizer="dropout(0.3)")
    main(["bake", str(tmp_path / "b.ply"), "--out", str(tmp_path / "b.spz")])
    compress_ply(plain, tmp_path / "a.spz", regularizer="dropout(0.3)")
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_a_file_for_the_web_needs_an_extra(plain, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(ImportError, match=r"ca_reg\[web\]"):
        compress_ply(plain, tmp_path / "a.sog")
