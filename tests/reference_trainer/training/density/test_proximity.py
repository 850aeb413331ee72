"""FSGS's density control against its rule, written as loops."""

import dataclasses
import math

import torch
from strategies import begun, some, stepped


def test_proximity_unpools_and_splits_the_sparse(tiny_scene):
    """A far group of four large Gaussians: against the rule, written out with loops over all pairs."""
    scene = dataclasses.replace(tiny_scene)
    start = some(30, seed=3, size=0.01)
    start.means[26:] = torch.tensor([[60.0, 0, 0], [64, 0, 0], [60, 9, 0], [60, 0, 30]])
    start.log_scales[26:] = math.log(2 * scene.extent)
    start.log_scales[29] = math.log(0.5 * scene.extent)  # far, but small
    optimizer = stepped(start)
    old = optimizer.gaussians.map(torch.Tensor.detach)
    pairs = [[(a - b).square().sum().item() for b in old.means.double()] for a in old.means.double()]
    near = [sorted((d, j) for j, d in enumerate(row) if j != i)[:3] for i, row in enumerate(pairs)]
    mean = [sum(d for d, _ in three) / 3 for three in near]
    distance = 0.5 * min(mean[i] for i in (26, 27, 28)) / scene.extent
    strategy = begun(f"proximity(100, {distance}, 1e9)", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    strategy.densify(optimizer, 99)
    expected = [i for i in range(30) if mean[i] > distance * scene.extent and old.scales[i].max() > scene.extent]
    assert expected == [26, 27, 28]
    new = optimizer.gaussians
    assert len(new) == 30 + 9
    for row, (i, j) in enumerate((source, target) for source in expected for _, target in near[source]):
        torch.testing.assert_close(new.means[30 + row], (old.means[i] + old.means[j]) / 2)
        assert torch.equal(new.log_scales[30 + row], old.log_scales[j])
        assert torch.equal(new.opacity_logits[30 + row], old.opacity_logits[j])
    assert torch.equal(new.quaternions[30:], torch.tensor([[1.0, 0, 0, 0]]).expand(9, 4))
    assert not new.sh[30:].any()
    assert not any(m[30:].any() for m in optimizer.state_dict()["moments"]["means"].values() if m.ndim)

    optimizer = stepped(start)
    strategy.densify(optimizer, 100)  # unpooling is over
    assert len(optimizer.gaussians) == 30
    splits = begun(f"proximity(0, 1e9, {distance})", scene, 30, dense_fraction=10.0, prune_opacity=0.0)
    splits.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 33
    torch.testing.assert_close(optimizer.gaussians.scales[27:], old.scales[[26, 27, 28] * 2] / 1.6)


def test_proximity_looks_at_neighbors_only_if_there_are_three(tiny_scene):
    optimizer = stepped(some(3, size=100.0))
    strategy = begun("proximity(distance=1e-9)", tiny_scene, 3, prune_opacity=0.0)
    strategy.densify(optimizer, 1)
    assert len(optimizer.gaussians) == 3
