"""`ns-train`, `ns-eval` and `ns-export` of the installed nerfstudio without CUDA; skipped where it is absent."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch

from reference_trainer.evaluation.pictures import save_png
from reference_trainer.model.ply import load_ply
from reference_trainer.scenes import synthetic_scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("nerfstudio") is None, reason="needs nerfstudio"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The built-in scene as nerfstudio reads it: transforms.json, which has OpenGL's cameras, and pictures."""
    root = tmp_path_factory.mktemp("built_in")
    scene = synthetic_scene(width=64, height=48, points=100)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    frames = []
    for kind, views in (("train", scene.train), ("eval", scene.test)):
        for i, view in enumerate(views):
            save_png(root / f"frame_{kind}_{i}.png", view.image)
            pose = torch.linalg.inv(view.camera.world_to_camera) @ flip
            frames.append({"file_path": f"frame_{kind}_{i}.png", "transform_matrix": pose.tolist()})
    camera = scene.train[0].camera
    size = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": 64, "h": 48}
    (root / "transforms.json").write_text(json.dumps({**size, "frames": frames}))
    return root


def run(folder, *arguments):
    """Run a command of nerfstudio's through the launcher."""
    launcher = [sys.executable, "-m", "ca_reg.integrations.run", "--cpu"]
    # nerfstudio loads its own checkpoints by pickle, which torch has refused by default since 2.6.
    environment = {**os.environ, "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*launcher, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stderr


@pytest.mark.parametrize(("method", "options", "said"), [
    ("splatfacto", ["--dropout", "0.2"], "20 renders"), ("splatfacto-ca", [], "ran plain"),
])  # fmt: skip
def test_a_training_ends_with_scores_and_a_ply(folder, method, options, said):
    end = run(
        folder, *options, "ns-train", method, "--max-num-iterations", "20", "--vis", "tensorboard", "--timestamp", "t",
        "--machine.device-type", "cpu", "--pipeline.model.num-downscales", "0", "--pipeline.model.num-random", "300",
        "--output-dir", "out", "--experiment-name", "e", "nerfstudio-data", "--data", ".", "--eval-mode", "filename",
    )  # fmt: skip
    assert said in end
    config = f"out/e/{method}/t/config.yml"
    run(folder, "ns-eval", "--load-config", config, "--output-path", f"{method}.json")
    results = json.loads((folder / f"{method}.json").read_text())["results"]
    assert results["psnr"] > 5
    assert ("ca" in results) == (method == "splatfacto-ca")
    run(folder, "ns-export", "gaussian-splat", "--load-config", config, "--output-dir", method)
    assert len(load_ply(folder / method / "splat.ply").gaussians) > 100
