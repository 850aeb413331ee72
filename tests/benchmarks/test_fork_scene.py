"""What a recipe and a fork are given is the same scene."""

import numpy as np
import pytest
import torch

from benchmarks.fork_scene import write_scene
from reference_trainer.scenes import load_scene, synthetic_scene
from reference_trainer.scenes.depth import point_prior
from reference_trainer.scenes.options import SceneOptions


def test_a_fork_reads_the_scene_of_the_recipe(tmp_path):
    scene = synthetic_scene(width=64, height=48, points=300)
    write_scene(scene, tmp_path)
    read = load_scene(SceneOptions(str(tmp_path), test="none", points="sparse/0/points3D.ply", depth="depth:inverse"))
    assert len(read.train) == len(scene.train)
    torch.testing.assert_close(read.points.positions, scene.points.positions, rtol=0, atol=0)
    torch.testing.assert_close(read.points.colors, scene.points.colors, rtol=0, atol=0.5001 / 255)
    for ours, theirs in zip(sorted(scene.train, key=lambda view: view.name), read.train, strict=True):
        torch.testing.assert_close(theirs.image, ours.image, rtol=0, atol=0.5001 / 255)
        torch.testing.assert_close(theirs.camera.world_to_camera, ours.camera.world_to_camera, rtol=0, atol=1e-5)
        intrinsics = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (ours.camera, theirs.camera)]
        assert intrinsics[0] == pytest.approx(intrinsics[1])
        nearness = 1 / point_prior(ours, scene.points).depth_prior
        known = nearness.isfinite()
        assert np.corrcoef(-theirs.depth_prior[known], nearness[known])[0, 1] > 0.999
