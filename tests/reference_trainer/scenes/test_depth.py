"""Depth priors from files: found by name, fitted to the photograph, refused by name."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.camera import Camera
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.depth import point_prior, read_depth
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud, View


@pytest.fixture
def scene(tmp_path, colmap_text, save_image):
    """A COLMAP scene of 64 x 48 pixels, two training photographs and a test photograph, with a ramp for depth."""
    root = tmp_path / "garden"
    colmap_text(root / "sparse" / "0")
    rng = np.random.default_rng(0)
    for name in ("a b", "b", "c"):
        save_image(root / "images" / f"{name}.png", rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    (root / "split.json").write_text(json.dumps({"train": ["b.png", "c.png"], "test": ["a b.png"]}))
    (root / "mono").mkdir()
    for name in ("b", "c"):
        np.save(root / "mono" / f"{name}.npy", RAMP.astype(np.float16))
    return root


RAMP = np.add.outer(np.arange(96), 2 * np.arange(128)) / 8 - 5  # twice the photograph's size, every value a float16
SMOOTH = np.round((RAMP[::2, ::2] - RAMP.min()) * 255 / np.ptp(RAMP[::2, ::2])).astype(np.uint8)  # of its size


def load(root, **options):
    return load_scene(SceneOptions(root, points="random:5", undistort=False, **options))


def test_training_views_get_the_depth_of_their_name_at_their_size(scene):
    loaded = load(scene, depth="mono")
    expected = RAMP.reshape(48, 2, 64, 2).mean((1, 3))  # a linear ramp, so that every good filter gives this inside
    for view in loaded.train:
        assert view.depth_prior.dtype == torch.float32
        np.testing.assert_allclose(view.depth_prior[3:-3, 3:-3], expected[3:-3, 3:-3], atol=1e-3)
    assert loaded.test[0].depth_prior is None
    assert load(scene).train[0].depth_prior is None
    assert load(scene, depth="mono", downscale=2).train[0].depth_prior.shape == (24, 32)


def test_an_inverse_depth_is_turned_so_that_more_is_farther(scene):
    plain, turned = (load(scene, depth=name).train[0].depth_prior for name in ("mono", "mono:inverse"))
    assert torch.equal(turned, -plain)
    assert torch.equal(load(scene, depth=str(scene / "mono")).train[0].depth_prior, plain)


@pytest.fixture
def bent_scene(scene):
    """The scene through a lens; all photographs and depth maps are `SMOOTH`."""
    for name in ("a b", "b", "c"):
        Image.fromarray(np.stack([SMOOTH] * 3, -1)).save(scene / "images" / f"{name}.png")
    cameras = (scene / "sparse" / "0" / "cameras.txt").read_text()
    (scene / "sparse" / "0" / "cameras.txt").write_text(
        cameras.replace("1 PINHOLE 64 48 50.5 51.25 32 24", "1 SIMPLE_RADIAL 64 48 50.5 32 24 0.4")
    )
    for name in ("b", "c"):
        np.save(scene / "mono" / f"{name}.npy", SMOOTH.astype(np.float32))
    return scene


def test_the_depth_is_undistorted_as_the_photograph_is(bent_scene):
    """The photograph's red is made the depth: after both went through the lens they still agree."""
    straight, bent = (
        load_scene(SceneOptions(bent_scene, points="random:5", depth="mono", undistort=on)).train[0]
        for on in (True, False)
    )
    assert (straight.image - bent.image).abs().max() > 0.01
    torch.testing.assert_close(straight.depth_prior / 255, straight.image[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("share", [0.05, 0.95])
@pytest.mark.parametrize("scale", [1, 2])
def test_of_a_map_with_holes_the_known_values_count(scene, share, scale):
    """A pixel is known if a value within it is known, and then near what it is without holes."""
    ramp = RAMP[:: 3 - scale, :: 3 - scale]
    whole, step = ramp.reshape(48, scale, 64, scale).mean((1, 3)), ramp[1, 1] - ramp[0, 0]
    holes = np.where(np.random.default_rng(0).random(ramp.shape) < share, ramp, np.nan)
    np.save(scene / "mono" / "b.npy", holes)
    found = load(scene, depth="mono").train[0].depth_prior.double().numpy()
    known, within = np.isfinite(found), np.isfinite(holes).reshape(48, scale, 64, scale).any((1, 3))
    assert known[within].all()
    assert (known == within).mean() > (0.9 if scale > 1 else 0.999)  # some have several known values just outside
    assert np.abs(found - whole)[known].max() < (1e-5 if scale == 1 else 1.501 * step)  # values up to 1.5 away count


def test_holes_go_through_the_lens(bent_scene):
    holes = np.where(np.random.default_rng(0).random((48, 64)) < 0.95, SMOOTH, np.nan)
    np.save(bent_scene / "mono" / "b.npy", holes)
    found, whole = (
        view.depth_prior for view in load_scene(SceneOptions(bent_scene, points="random:5", depth="mono")).train
    )
    known = found.isfinite()
    assert 0.95 < known.float().mean() < 1
    step = SMOOTH[1, 1] - SMOOTH[0, 0]
    assert (found - whole)[known].abs().max() < step
    edge = np.full((48, 64), np.nan)
    edge[23:25, 0] = 1.0, 2.0  # which the undistorted photograph no longer shows
    np.save(bent_scene / "mono" / "b.npy", edge)
    with pytest.raises(ValueError, match=r"b\.npy .*unknown everywhere"):
        load_scene(SceneOptions(bent_scene, points="random:5", depth="mono"))


def test_kinds_of_files(tmp_path):
    rng = np.random.default_rng(0)
    for bits, kind in ((8, np.uint8), (16, np.uint16)):
        pixels = rng.integers(0, 2**bits, (5, 7)).astype(kind)
        Image.fromarray(pixels).save(tmp_path / "x.png")
        np.testing.assert_array_equal(read_depth(tmp_path / "x.png"), pixels)
    for array in (rng.random((5, 7)), rng.random((1, 5, 7), np.float32), rng.integers(0, 9, (5, 7, 1))):
        np.save(tmp_path / "x.npy", array)
        np.testing.assert_array_equal(read_depth(tmp_path / "x.npy"), array.reshape(5, 7).astype(np.float32))
    np.save(tmp_path / "x.npy", np.array([[1.0, np.inf], [np.nan, -2.0]]))
    assert read_depth(tmp_path / "x.npy").isnan().tolist() == [[False, True], [True, False]]


def test_unreadable_files_are_named(tmp_path):
    np.save(tmp_path / "color.npy", np.zeros((4, 4, 3)))
    np.save(tmp_path / "objects.npy", np.array([[None]], dtype=object))
    (tmp_path / "text.npy").write_text("no array")
    (tmp_path / "text.png").write_text("no picture")
    np.save(tmp_path / "cut.npy", np.zeros((50, 50)))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cut.npy").read_bytes()[:500])
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "color.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).convert("P").save(tmp_path / "palette.png")
    for path in tmp_path.iterdir():
        with pytest.raises(ValueError, match=path.name):
            read_depth(path)


def test_missing_and_mismatched_files_are_named(scene):
    (scene / "mono" / "c.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"no depth .*c\.png.*b\.npy"):
        load(scene, depth="mono")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        load(scene, depth="nothing")
    for array, message in (
        (RAMP.T, "96x128, which is not the shape"),
        (np.ones((48, 64)), "holds no depth"),
        (np.full((48, 64), np.nan), "holds no depth"),
    ):
        np.save(scene / "mono" / "c.npy", array)
        with pytest.raises(ValueError, match=rf"c\.npy.*{message}"):
            load(scene, depth="mono")


def test_the_built_in_scene_has_its_true_depth():
    scene = load_scene(SceneOptions("synthetic", downscale=8, depth="true"))
    for view in scene.train:
        hit = view.depth > 0
        assert torch.equal(view.depth_prior[hit], view.depth[hit])
        assert view.depth_prior[~hit].isnan().all()
    with pytest.raises(ValueError, match=r'"points", got \'mono\''):
        load_scene(SceneOptions("synthetic", downscale=8, depth="mono"))


def test_between_points_on_a_plane_the_prior_is_the_plane_and_what_is_behind_it_hides():
    """The inverse depth of a plane is linear over the picture: interpolated linearly it is exact."""
    camera = Camera(torch.eye(4), fx=50.0, fy=55.0, cx=21.0, cy=15.0, width=40, height=30)
    view = View("v", camera, torch.zeros(3, 30, 40))
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(60, 2, generator=generator, dtype=torch.float64) * torch.tensor([40.0, 30.0])

    def inverse_depth(pixels):
        return 0.2 + 0.004 * pixels[..., 0] - 0.003 * pixels[..., 1]

    points = camera.lift(pixels, 1 / inverse_depth(pixels))
    hidden = camera.lift(pixels, 9 / inverse_depth(pixels))
    behind = -points
    cloud = PointCloud(torch.cat([hidden, points, behind]).float(), torch.zeros(180, 3), source="a model")
    prior = point_prior(view, cloud).depth_prior
    centers = torch.stack(torch.meshgrid(torch.arange(40) + 0.5, torch.arange(30) + 0.5, indexing="xy"), -1)
    inside = prior.isfinite()
    assert 0.6 < inside.float().mean() < 1
    torch.testing.assert_close(prior[inside], (1 / inverse_depth(centers))[inside].float(), rtol=1e-5, atol=0)
    with pytest.raises(ValueError, match="these are random"):
        point_prior(view, PointCloud(points.float(), torch.zeros(60, 3), source="random"))
    row = torch.arange(4, 20, dtype=torch.float64)
    in_line = camera.lift(torch.stack([row, row + 0.25], 1), torch.ones_like(row))  # beside the centers of the pixels
    for few, number in ((behind, 0), (points[:2], 2), (in_line, 16)):
        with pytest.raises(ValueError, match=f"{number} pixels of v .*triangle"):
            point_prior(view, PointCloud(few.float(), torch.zeros(len(few), 3), source="a model"))


def test_the_built_in_scene_has_points_to_make_a_prior_of():
    """Triangles that span an edge of an object are off; half of the pixels are within five percent of the truth."""
    for view in load_scene(SceneOptions("synthetic", downscale=2, depth="points")).train:
        known = view.depth_prior.isfinite() & (view.depth > 0)
        assert known.float().mean() > 0.5
        assert (view.depth_prior / view.depth - 1)[known].abs().median() < 0.05
