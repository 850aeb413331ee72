"""Scenes of one .npz, of cameras that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from reference_trainer.scenes import load_scene
from reference_trainer.scenes.numpy_formats import MOST_POINTS, read_arrays
from reference_trainer.scenes.options import SceneOptions

NAMES = ("a.png", "b.png", "c.png")
# Cameras 2 units to the right of each other; the last is turned by 90 degrees: its forward is the world's x.
CENTERS = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 1.0, 0.0]])
AXES = np.stack([np.eye(3), np.eye(3), np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])])
INTRINSICS = np.array([[10.0, 0.0, 4.0], [0.0, 12.0, 3.0], [0.0, 0.0, 1.0]])


def to_camera() -> np.ndarray:
    return np.concatenate([AXES, -AXES @ CENTERS[:, :, None]], 2)


def to_world() -> np.ndarray:
    return np.concatenate([AXES.transpose(0, 2, 1), CENTERS[:, :, None]], 2)


def square(poses: np.ndarray) -> np.ndarray:
    return np.concatenate([poses, np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(poses), 1, 4))], 1)


@pytest.fixture
def scene(tmp_path, save_image):
    """A folder of three pictures, 8x6, and a function that puts an .npz beside them."""
    for i, name in enumerate(NAMES):
        save_image(tmp_path / "images" / name, np.full((6, 8, 3), 40 * i, np.uint8))

    def write(**arrays: np.ndarray):
        np.savez(tmp_path / "predictions.npz", **arrays)
        return tmp_path

    return write


def points_of(root):
    cloud = read_arrays(root / "predictions.npz", root / "images")[1]
    assert cloud is not None
    return cloud


@pytest.mark.parametrize(
    "poses",
    [
        {"extrinsic": to_camera()}, {"w2c": square(to_camera())}, {"extrinsics": to_camera().astype(np.float32)},
        {"c2w": square(to_world())}, {"camera_poses": to_world()},
    ],
    ids=lambda poses: next(iter(poses)),
)  # fmt: skip
@pytest.mark.parametrize("one", [True, False])
def test_the_name_tells_which_way_the_poses_go(scene, poses, one):
    k = INTRINSICS if one else np.stack([INTRINSICS] * 3)
    loaded = load_scene(SceneOptions(scene(**poses, intrinsics=k, points=np.ones((1, 3)))))
    assert [view.name for view in loaded.train] == list(NAMES)
    for view, center, axes in zip(loaded.train, CENTERS, AXES, strict=True):
        assert view.camera.position.numpy() == pytest.approx(center, abs=1e-6)
        assert view.camera.forward.numpy() == pytest.approx(axes[2], abs=1e-6)
        assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == (10, 12, 4, 3)


@pytest.mark.parametrize(
    "maps",
    [
        {"images": np.zeros((3, 3, 12, 16), np.float32)}, {"images": np.zeros((3, 12, 16, 3), np.uint8)},
        {"depth": np.ones((3, 12, 16))}, {"depth": np.ones((3, 12, 16, 1), np.float32)},
        {"world_points": np.ones((3, 12, 16, 3))},
    ],
)  # fmt: skip
def test_intrinsics_are_of_the_pictures_that_were_predicted_from(scene, maps):
    root = scene(extrinsic=to_camera(), intrinsic=INTRINSICS, **maps)
    for frame in read_arrays(root / "predictions.npz", root / "images")[0]:
        camera = frame.camera
        assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (16, 12, 10, 12, 4, 3)


def test_pictures_by_name_whatever_folder_they_were_in(scene):
    names = np.array(["/home/somebody/c.png", "C:\\photos\\a.png", "b.png"])
    root = scene(extrinsic=to_camera(), intrinsic=INTRINSICS, image_names=names)
    frames, points = read_arrays(root / "predictions.npz", root / "images")
    assert [frame.path.name for frame in frames] == ["c.png", "a.png", "b.png"]
    assert [frame.camera.position.tolist() for frame in frames] == CENTERS.tolist()
    assert points is None


def test_points_with_their_colors(scene):
    xyz, rgb = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, 5.0, 6.0]]), np.array([[255, 0, 51]] * 3, np.uint8)
    cloud = points_of(scene(extrinsic=to_camera(), intrinsic=INTRINSICS, points=xyz, colors=rgb))
    assert cloud.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    torch.testing.assert_close(cloud.colors, torch.tensor([[1.0, 0.0, 0.2]] * 2))
    assert cloud.seen_by == frozenset(NAMES)


def test_a_map_of_points_takes_the_colors_of_the_pictures_and_the_surer_half(scene):
    points = np.random.default_rng(0).normal(size=(3, 3, 4, 3))
    images = np.random.default_rng(1).random((3, 3, 3, 4)).astype(np.float32)
    sure = np.arange(36.0).reshape(3, 3, 4)
    cloud = points_of(
        scene(extrinsic=to_camera(), intrinsic=INTRINSICS, world_points=points, images=images, world_points_conf=sure)
    )
    assert cloud.positions.numpy() == pytest.approx(points.reshape(-1, 3)[18:])
    expected = np.array([images[i, :, y, x] for i in range(3) for y in range(3) for x in range(4)])[18:]
    assert cloud.colors.numpy() == pytest.approx(expected)


@pytest.mark.parametrize(("unknown", "kept"), [([0, 7], [5, 6, 8, 9]), (range(10), [])])
def test_points_of_unknown_confidence_are_left_out(scene, unknown, kept):
    points, sure = np.arange(30.0).reshape(10, 3), np.arange(10.0)  # of 1 to 6, 8 and 9 the median is 4.5
    sure[list(unknown)] = np.nan
    root = scene(extrinsic=to_camera(), intrinsic=INTRINSICS, points=points, confidence=sure)
    cloud = read_arrays(root / "predictions.npz", root / "images")[1]
    assert (cloud.positions[:, 0].tolist() if cloud else []) == [3 * i for i in kept]


def test_depth_is_lifted_along_the_axis_of_the_camera(scene):
    depth = np.full((3, 6, 8), 5.0)
    depth[:, 0, 0] = 0  # unknown
    cloud = points_of(scene(extrinsic=to_camera(), intrinsic=INTRINSICS, depth=depth))
    assert len(cloud.positions) == 3 * 47
    # Pixel (1, 0): center (1.5, 0.5), so (1.5 - 4) / 10 and (0.5 - 3) / 12 of the depth across.
    x, y = 5 * -0.25, 5 * -2.5 / 12
    torch.testing.assert_close(cloud.positions[0], torch.tensor([x, y, 5.0]))
    torch.testing.assert_close(cloud.positions[2 * 47], torch.tensor([4.0 + 5.0, 1 + y, -x]))  # turned: z = -right


def test_depth_of_half_the_size_of_the_pictures_is_lifted_alike(scene):
    depth, pictures = np.full((3, 6, 8), 5.0), np.zeros((3, 3, 12, 16))
    expected = points_of(scene(extrinsic=to_camera(), intrinsic=INTRINSICS, depth=depth)).positions
    twice = INTRINSICS * [[2.0], [2.0], [1.0]]
    cloud = points_of(scene(extrinsic=to_camera(), intrinsic=twice, depth=depth, images=pictures))
    torch.testing.assert_close(cloud.positions, expected)


def test_few_of_many_points(scene):
    points = np.random.default_rng(0).random((3 * MOST_POINTS - 1, 3))
    cloud = points_of(scene(extrinsic=to_camera(), intrinsic=INTRINSICS, points=points))
    assert cloud.positions.numpy() == pytest.approx(points[::3].astype(np.float32))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"pose": to_camera(), "K": INTRINSICS}, r"needs poses, called extrinsic, .* it has \['K'\]"),
        ({"extrinsic": to_camera()}, r"needs poses, .* and intrinsics, called intrinsic, .* \['extrinsic'\]"),
        ({"extrinsic": to_camera()[:2], "K": INTRINSICS}, "2 cameras .*3 images"),
        ({"extrinsic": to_camera()[:, :2], "K": INTRINSICS}, r"got \(3, 2, 4\) and \(3, 3, 3\)"),
        ({"extrinsic": 2 * to_camera(), "K": INTRINSICS}, "camera of a.png: .*no rotation"),
        ({"extrinsic": to_camera(), "K": 0 * INTRINSICS}, "camera of a.png: focal lengths .*positive"),
        ({"extrinsic": to_camera(), "K": INTRINSICS, "points": np.ones((4, 2))}, r"\(\.\.\., 3\), got \(4, 2\)"),
        ({"extrinsic": to_camera(), "K": INTRINSICS, "depth": np.ones((2, 6, 8))}, r"got \(2, 6, 8\) for 3 cameras"),
        ({"extrinsic": to_camera(), "K": INTRINSICS, "depth": np.ones((3, 8))}, r"got \(3, 8\) for 3 cameras"),
        ({"extrinsic": to_camera(), "K": INTRINSICS, "points": np.ones((3, 3, 4))}, r"\(\.\.\., 3\), got \(3, 3, 4\)"),
        ({"extrinsic": np.array(1.0), "K": INTRINSICS}, r"got \(\) and \(3, 3\)"),
        ({"extrinsic": np.array(["a"]), "K": INTRINSICS}, "needs poses"),
        ({"extrinsic": np.array([None]), "K": INTRINSICS}, "numbers or text"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(scene, arrays, message):
    with pytest.raises(ValueError, match=message):
        load_scene(SceneOptions(scene(**arrays)))


def test_two_files(scene):
    root = scene(extrinsic=to_camera(), intrinsic=INTRINSICS)
    np.savez(root / "other.npz", a=np.ones(1))
    with pytest.raises(ValueError, match=r"one \.npz .*\['other\.npz', 'predictions\.npz'\]"):
        load_scene(SceneOptions(root))
