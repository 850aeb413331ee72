"""The examples of the README run in the form in which they stand there.

Its two commands at the top are what `.ci/run` begins with.
"""

import itertools
import json
import shlex
import shutil
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from launched import FILES
from oracles import brute_force, random_scene
from pages import ROOT, blocks
from PIL import Image
from stand_ins import gsplat as gsplat_stand_in
from subprocesses import subprocess_environment

from ca_reg import CAScore
from ca_reg.integrations import gsplat_model
from reference_trainer.cli import main, photos
from reference_trainer.model.gaussians import SH_C0
from reference_trainer.scenes import synthetic_scene

README = ROOT / "README.md"
NAMES = "two lines", "a third", "chain", "gsplat", "score", "exact score"
PYTHON = dict(zip(NAMES, blocks(README, "python"), strict=True))
COMMANDS = [
    shlex.split(line, comments=True)
    for block in blocks(README, "bash")
    for line in block.splitlines()
    if line.startswith(("ca-reg", "python"))
]
QUICK = {
    "run": ["--quick", "--no-open"],
    "train": ["--iterations", "4", "--images", "images"],
    # A process for each run, with as many steps as it takes until the score covers the pictures.
    "compare": ["--iterations", "60", "--images", "images", "--seeds", "1", "--strategies", "baseline", "dropout"],
}


def run(example, **names):
    """Run a block of Python, with the reader's own names; return all names."""
    exec(compile(PYTHON[example], f"README.md, {example}", "exec"), names)
    return SimpleNamespace(**names)


@pytest.fixture
def gaussians():
    return SimpleNamespace(get_opacity=torch.full((1000, 1), 0.5, requires_grad=True))


def test_two_lines(gaussians):
    found = run("two lines", gaussians=gaussians, radii=torch.ones(1000, dtype=torch.int32))
    assert torch.equal(found.radii == 0, found.opacity.squeeze(1) == 0)
    assert 0 < (found.radii == 0).sum() < 1000
    scaled = found.dropout.eval()(gaussians.get_opacity)
    assert torch.equal(scaled, torch.full((1000, 1), 0.4))


def test_a_third_line():
    logits = torch.nn.Parameter(torch.zeros(10, 1))
    run("a third", gaussians=SimpleNamespace(_opacity=logits), step=501)
    torch.testing.assert_close(logits.detach().sigmoid(), torch.full((10, 1), 0.4975))


def test_the_chain_drops_and_leaves_the_global_random_state_alone(gaussians):
    before = torch.random.get_rng_state()
    generator = torch.Generator().manual_seed(0)
    found = run("chain", gaussians=gaussians, radii=torch.ones(1000), step=5_000, generator=generator)
    assert torch.equal(torch.random.get_rng_state(), before)
    dropped = found.radii == 0
    assert (found.opacity[dropped] == 0).all()
    assert dropped.float().mean() == pytest.approx(0.1, abs=0.05)  # half-way up the ramp
    assert found.opacity[~dropped].unique().numel() > 500  # and noise on the others


def test_gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", gsplat_stand_in)
    rasterization = run("gsplat").rasterization
    means, opacities = torch.rand(400, 3), torch.full((400,), 0.5, requires_grad=True)
    view, k = torch.eye(4)[None], torch.tensor([[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]])
    view[0, 2, 3] = 2
    scales, quats = torch.full((400, 3), 0.05), torch.tensor([[1.0, 0, 0, 0]]).expand(400, 4)
    _, _, info = rasterization(means, quats, scales, opacities, torch.rand(400, 3), view, k, 32, 32, packed=False)
    bare = gsplat_stand_in.rasterization(
        means, quats, scales, opacities, torch.rand(400, 3), view, k, 32, 32, packed=False
    )[2]
    shown, all_shown = ((x["radii"][0] > 0).all(-1) for x in (info, bare))
    assert 0 < (all_shown & ~shown).sum() < 0.5 * all_shown.sum()


def test_the_score(gaussians, capsys):
    """A pixel for each Gaussian, 0.5 or left out: its variance over 5 renders is on average 4/5 of 0.5^2 / 4."""

    def rasterize(of, opacity, view):
        assert of is gaussians
        return opacity.view(1, 25, 40).expand(3, -1, -1), torch.ones(25, 40)

    found = run("score", gaussians=gaussians, rasterize=rasterize, view=None)
    value, std_error = (float(x) for x in capsys.readouterr().out.split()[:2])
    assert (value, std_error) == pytest.approx((found.result.value, found.result.std_error))
    assert value == pytest.approx(0.8 * 0.5**2 / 4, rel=0.05)  # 1,000 pixels, 5 renders: 2 % of standard error


def test_the_exact_score_of_gsplat(monkeypatch, capsys):
    """The variance over all masks of six Gaussians, each as likely as any, over gsplat's own torch functions."""
    pytest.importorskip("gsplat.cuda._torch_impl", exc_type=ImportError)
    monkeypatch.setattr(gsplat_model, "load_gsplat", lambda device: gsplat_stand_in.package())
    gsplat_model.largest_alpha.cache_clear()
    scene = gsplat_stand_in.centered(random_scene(6, 12, 10, seed=9, size=0.4))
    # In one place, so that half of them cover a pixel; none so opaque that a render would stop early.
    scene = scene._replace(means=0.2 * scene.means, opacities=0.6 + 0.1 * scene.opacities)
    images, alphas = zip(
        *(
            brute_force(*scene[:3], scene.opacities * torch.tensor(keep).double(), scene.colors, scene.camera)
            for keep in itertools.product((0.0, 1.0), repeat=6)
        ),
        strict=True,
    )
    visible = torch.stack(alphas).mean(0) > 0.8
    assert 10 < visible.sum() < 120
    sh = torch.zeros(6, 16, 3, dtype=torch.float64)
    sh[:, 0] = (scene.colors - 0.5) / SH_C0
    run(
        "exact score", CAScore=CAScore, means=scene.means, quats=scene.quaternions, scales=scene.scales,
        sh=sh, opacities=scene.opacities, viewmat=scene.camera.world_to_camera,
        K=gsplat_stand_in.intrinsics(scene.camera), width=12, height=10,
    )  # fmt: skip
    gsplat_model.largest_alpha.cache_clear()
    expected = torch.stack(images).var(0, unbiased=False).mean(0)[visible].mean().item()
    assert float(capsys.readouterr().out) == pytest.approx(expected, rel=1e-3)


def camera_file(scene):
    """Write the cameras of views as transforms.json has them, OpenGL and camera to world."""
    frames = []
    for view in scene.train:
        pose, camera = np.linalg.inv(view.camera.world_to_camera.double().numpy()), view.camera
        pose[:, 1:3] *= -1
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": pose.tolist(), "fl_x": camera.fx,
                       "w": camera.width, "h": camera.height})  # fmt: skip
    return json.dumps({"frames": frames})


@pytest.fixture
def my_photos(tmp_path, monkeypatch):
    """A folder of three photographs with cameras; `test_tutorial.py` has real ones without."""
    folder = tmp_path / "my_photos" / "images"
    folder.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    scene = synthetic_scene(width=48, height=36)
    for view in scene.train:
        pixels = (view.image.permute(1, 2, 0) * 255).round().byte().numpy()
        Image.fromarray(pixels).save(folder / f"{view.name}.png")
    (folder.parent / "transforms.json").write_text(camera_file(scene))
    return tmp_path


@pytest.mark.slow
def test_from_photographs_to_a_page(my_photos, capsys, monkeypatch):
    """Every command for photographs, one after the other, with few steps."""
    monkeypatch.setattr(photos, "PRESETS", {"quick": (30, 20_000)})
    for _, *arguments in (command for command in COMMANDS if command[0] == "ca-reg"):
        name = arguments[0]
        if name in ("view", "poses"):  # which wait for a browser, and look for cameras
            continue
        if name == "evaluate":  # a model trained without dropout, for `clean` too
            shutil.copy(my_photos / "runs/compare/baseline/seed_0/point_cloud.ply", my_photos)
        main([*arguments, *QUICK.get(name, [])])
    assert (my_photos / "runs/mine/point_cloud.ply").is_file()
    assert list((my_photos / "runs/mine").glob("*.html"))
    assert "dropout" in capsys.readouterr().out


@pytest.mark.slow
def test_the_launcher(tmp_path):
    """The line for the INRIA family, on a code base with its layout."""
    (_, *arguments), *_ = [command for command in COMMANDS if "train.py" in command]
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text).replace("int(sys.argv[1])", "3"))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=tmp_path, env=subprocess_environment(), capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "argv ['-s', 'my_scene']" in done.stdout
    assert "3 renders regularized, steps 1 to 3" in done.stderr


def test_the_citation_is_that_of_the_package():
    import ca_reg

    text = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {ca_reg.__version__}\n" in text
    (bibtex,) = blocks(README, "bibtex")
    title = "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting"
    assert title in text
    assert title in bibtex
    authors = ("Chen, Kangjie", "Zhong", "Li, Z", "Lin, J", "Chen, Youyu", "Qin", "Wang")
    assert sorted(authors, key=bibtex.index) == list(authors)
