import itertools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from reference_trainer.camera import Camera
from reference_trainer.cli import main
from reference_trainer.scenes import synthetic_scene
from reference_trainer.scenes.dense import SOURCE, dense_points, dense_start, source_views
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import PointCloud, View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.plan import make_plan

pytest.importorskip("numba")
# Where compiled loops are kept is decided here: in the tests' own folders each process would compile them again.
from reference_trainer.compiled import stereo  # noqa: F401
from reference_trainer.render.numba import binning, compositing, moments, projection  # noqa: F401
from reference_trainer.training.losses import _ssim_numba  # noqa: F401


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def courtyard():
    return synthetic_scene()


def off(cloud, views):
    """The relative error of every point's depth, in the view where it is least: the others may see it hidden."""
    found = []
    for view in views:
        pixels, depths = view.camera.project(cloud.positions)
        inside = view.camera.inside(pixels, depths)
        column, row = pixels.where(inside[:, None], 0).long().unbind(1)
        true = view.depth[row, column]
        found.append(((depths / true - 1).abs()).where(inside & (true > 0), torch.inf))
    return torch.stack(found).amin(0)


def covered(cloud, view):
    """The share of the 8 x 8 cells of a picture in which there is a point."""
    pixels, depths = view.camera.project(cloud.positions)
    cells = (pixels[view.camera.inside(pixels, depths)] / 8).long()
    return len(torch.unique(cells, dim=0)) / (math.ceil(view.camera.width / 8) * math.ceil(view.camera.height / 8))


@pytest.mark.slow
@pytest.mark.parametrize("guided", [True, False])
def test_points_lie_on_the_surfaces_of_the_built_in_scene(courtyard, guided):
    cloud = dense_points(courtyard.train, courtyard.points if guided else None)
    errors = off(cloud, courtyard.train)
    assert 10_000 < len(errors) <= 15_000
    assert cloud.seen_by == {view.name for view in courtyard.train}
    # Measured: 14 and 7 %, nearly all of them beside the columns and spheres, in strips that one view cannot see.
    assert (errors > 0.02).float().mean() < 0.18
    assert (errors > 0.1).float().mean() < 0.09
    assert min(covered(cloud, view) for view in courtyard.train) > 0.75
    confident = cloud.confidence > 0.9
    assert confident.float().mean() > 0.25
    assert (errors[confident] > 0.02).float().mean() < 0.05
    assert (errors[confident] > 0.1).float().mean() < 0.03


def looking(x, *, turn=0.0, width=160, height=120, focal=150.0):
    """A camera at (x, 0, 0) that looks along z, turned about the vertical axis by an angle."""
    axes = torch.tensor([[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ torch.tensor([x, 0.0, 0.0])
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


WAVES = torch.randn(40, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor([9.0, 9.0, 0.0])
PHASES = torch.rand(40, 3, generator=torch.Generator().manual_seed(4)) * 2 * math.pi


def plane_view(name, camera, slope, distance=5.0):
    """Photograph the plane z = distance + slope x, painted with waves, by intersecting it with every pixel's ray."""
    row, column = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    far = camera.lift(torch.stack([column, row], -1), torch.ones(camera.height, camera.width)) - camera.position
    z0 = distance + slope * camera.position[0] - camera.position[2]
    depth = z0 / (far[..., 2] - slope * far[..., 0])
    points = camera.position + far * depth[..., None]
    waves = torch.sin((points @ WAVES.T)[..., None] + PHASES)  # (H, W, 40, 3)
    image = (0.5 + 0.06 * waves.sum(2)).clamp(0, 1).permute(2, 0, 1).contiguous()
    return View(name, camera, image, depth=depth)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_depth_of_a_tilted_plane(slope):
    """At 0 and 45 degrees, from three cameras; 2 % of the depth are 0.4 pixels of motion between two of them."""
    cameras = [looking(-0.6, turn=0.1), looking(0.0), looking(0.6, turn=-0.1)]
    views = [plane_view(str(i), camera, slope) for i, camera in enumerate(cameras)]
    cloud = dense_points(views)
    x, _, z = cloud.positions.unbind(1)
    errors = ((5 + slope * x) / z - 1).abs()
    assert len(errors) > 10_000
    assert errors.median() < 0.005
    assert (errors > 0.02).float().mean() < 0.05
    assert (errors > 0.1).float().mean() < 0.01
    assert min(covered(cloud, view) for view in views) > 0.85


def pair(**changes):
    """Two photographs of the plane, small, with changes to the second."""
    size = {"width": 64, "height": 48, "focal": 60.0}
    views = [plane_view(name, looking(x, **size), 0.2) for name, x in (("a", -0.25), ("b", 0.25))]
    return [views[0], replace(views[1], **changes)]


def test_two_small_photographs_do_and_repeat():
    first, again = (dense_points(pair(), count=600) for _ in range(2))
    x, _, z = first.positions.unbind(1)
    assert ((5 + 0.2 * x) / z - 1).abs().median() < 0.01
    assert torch.equal(first.positions, again.positions)
    assert torch.equal(first.colors, again.colors)


def test_what_lies_far_behind_the_measured_points_is_found_as_well():
    """The plane is twice as far as all that is known, which is a thing before it that has too little texture."""
    views = pair()
    pixels = torch.cartesian_prod(torch.arange(4.0, 64, 7), torch.arange(4.0, 48, 6))
    near = views[0].camera.lift(pixels, torch.full((len(pixels),), 2.3))
    cloud = dense_points(views, PointCloud(near, torch.zeros_like(near), "known"), count=1_000)
    x, _, z = cloud.positions.unbind(1)
    assert ((5 + 0.2 * x) / z - 1).abs().median() < 0.02


def test_photographs_are_matched_by_how_differently_they_see_what_is_known_and_not_what_is_behind():
    """Half of the known points is seen from directions 64 degrees apart, which is too much; the middle of the sweep,
    which the farther ones stretch, from 6 degrees apart."""
    views = pair()
    depths = torch.tensor([0.4, 0.4, 0.4, 40.0]).repeat(20)
    middle = torch.tensor([32.0, 24.0]).expand(len(depths), 2)
    known = torch.cat([view.camera.lift(middle, depths) for view in views])
    with pytest.raises(ValueError, match="only 0 points"):
        dense_points(views, PointCloud(known, torch.zeros_like(known), "known"), count=600)


def test_what_cannot_be_measured_is_refused_with_the_reason():
    views = pair()
    noise = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    elsewhere = looking(0.25, turn=math.pi, width=64, height=48, focal=60.0)
    for given, reason in (
        (views[:1], "at least 2 different training photographs, got 1: choose"),
        (pair(image=views[0].image), "at least 2 different .*, got 1 .b shows the same as a and is left out.: choose"),
        (
            [replace(view, image=torch.full((3, 48, 64), 0.3 * i)) for i, view in enumerate(views)],
            "only 0 points.*texture",
        ),
        (
            [replace(view, image=image) for view, image in zip(views, noise, strict=True)],
            "points on which the 2 training",
        ),
        (pair(camera=elsewhere), "only 0 points.*overlap"),
        (pair(camera=views[0].camera), "only 0 points"),
    ):
        with pytest.raises(ValueError, match=f"a dense start .*{reason}"):
            dense_points(given)


def test_a_photograph_that_is_there_twice_does_not_count(caplog):
    first, second = pair()
    copy = replace(first, name="c", image=(first.image + 0.003).clamp(0, 1))  # saved again, with another camera
    copy = replace(copy, camera=looking(-0.26, width=64, height=48, focal=60.0))
    with caplog.at_level("INFO"):
        cloud = dense_points([first, second, copy], count=600)
    assert "c shows the same as a and is left out" in caplog.text
    assert cloud.seen_by == {"a", "b"}
    assert torch.equal(cloud.positions, dense_points([first, second], count=600).positions)


def test_transparent_pixels_give_no_points():
    left = torch.zeros(48, 64)
    left[:, :24] = 1.0
    cloud = dense_points([replace(view, alpha=left) for view in pair()], count=300)
    for view in pair():
        pixels, _ = view.camera.project(cloud.positions)
        assert (pixels[:, 0] < 24 + 8).all()  # those of the other view lie up to 6 pixels further right


def test_source_views_are_near_but_not_too_near():
    cameras = [looking(x) for x in (0.0, 0.01, 0.8, 1.2, 30.0)]
    assert source_views(cameras, 0, 5.0) == [2, 3]  # 9 and 13 degrees apart, more overlap; 0.1 and 80 degrees


def test_of_two_source_views_in_one_place_one_is_taken():
    cameras = [looking(x) for x in (0.0, 1.0, 1.01, 0.5)]
    assert source_views(cameras, 0, 5.0)[0] in (1, 2)
    assert source_views(cameras, 0, 5.0)[1:] == [3]


def test_aggregation_is_the_recurrence_of_semi_global_matching():
    """Against the formula for every pixel and plane, along all eight directions; edges make a jump cheaper."""
    from reference_trainer.compiled.stereo import aggregate

    rng = np.random.default_rng(0)
    cost, picture = rng.random((5, 6, 16), np.float32), rng.random((5, 6), np.float32)
    small, large = 0.05, 0.4
    for dy, dx in itertools.product((-1, 0, 1), repeat=2):
        if (dy, dx) == (0, 0):
            continue
        path = np.zeros(cost.shape)
        for y in sorted(range(5), reverse=dy < 0):
            for x in sorted(range(6), reverse=dx < 0):
                path[y, x] = cost[y, x]
                if not (0 <= y - dy < 5 and 0 <= x - dx < 6):
                    continue
                before = path[y - dy, x - dx]
                jump = max(large / (1 + 20 * abs(picture[y, x] - picture[y - dy, x - dx])), 2 * small)
                for d in range(16):
                    steps = [before[e] + (0 if e == d else small if abs(e - d) == 1 else jump) for e in range(16)]
                    path[y, x, d] += min(steps) - before.min()
        total = np.zeros_like(cost)
        paths = 5 if dy == 0 else 6 if dx == 0 else 10
        aggregate(0, paths, dy, dx, picture, cost, total, np.float32(small), np.float32(large))
        np.testing.assert_allclose(total, path, atol=1e-5)


def written(root, views):
    """Write views as a scene folder of nerfstudio's format."""
    frames = []
    (root / "images").mkdir(parents=True)
    for view in views:
        pose = view.camera.world_to_camera.double().inverse() @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        frames.append({"file_path": f"images/{view.name}.png", "transform_matrix": pose.tolist()})
        pixels = (255 * view.image.permute(1, 2, 0)).round().byte().numpy()
        Image.fromarray(pixels).save(root / f"images/{view.name}.png")
    camera = views[0].camera
    numbers = {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }
    (root / "transforms.json").write_text(json.dumps(numbers | {"frames": frames}))


def plane(*at):
    """Small photographs of the plane, taken from beside one another."""
    size = {"width": 64, "height": 48, "focal": 60.0}
    return [plane_view(f"{i}", looking(x, **size), 0.2) for i, x in enumerate(at)]


def few_points(root, number):
    """Write so many points of the plane as those of the scene file."""
    x, y = torch.rand(2, number, generator=torch.Generator().manual_seed(1)) - 0.5
    points = torch.stack([x, y, 5 + 0.2 * x], 1)
    lines = [f"{' '.join(f'{c:.6f}' for c in point)} 9 9 9" for point in points.tolist()]
    kinds = [*(f"property float {c}" for c in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    head = ["ply", "format ascii 1.0", f"element vertex {number}", *kinds, "end_header"]
    (root / "few.ply").write_text("\n".join([*head, *lines]) + "\n")
    scene = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps(scene | {"ply_file_path": "few.ply"}))
    return points


def test_few_measured_points_and_a_dense_start_are_what_a_training_begins_with_unasked(tmp_path):
    written(tmp_path / "scene", plane(-0.3, 0.0, 0.3))
    few = few_points(tmp_path / "scene", 99)
    scene = load_scene(SceneOptions(str(tmp_path / "scene")))
    x, _, z = scene.points.positions.unbind(1)
    assert len(x) > 1000
    assert ((5 + 0.2 * x) / z - 1).abs().median() < 0.01
    assert torch.allclose(scene.points.positions[-99:], few, atol=1e-5)
    assert len(scene.points.confidence) == len(scene.points.colors) == len(x)
    assert "dense stereo, and 99 from" in str(scene)
    kept = load_scene(SceneOptions(str(tmp_path / "scene")), trains=False).points
    assert len(kept.positions) == 99  # enough for what trains nothing, and at once


def test_a_photograph_that_is_there_twice_leaves_the_others_their_dense_start(tmp_path):
    written(tmp_path / "scene", plane(-0.3, 0.0, 0.3, 0.3))
    scene = load_scene(SceneOptions(str(tmp_path / "scene")))
    assert scene.points.source == SOURCE
    assert "measured on the 3 training photographs by dense stereo (images/3 shows the same as images/2" in str(scene)


def test_ten_thousand_measured_points_are_enough(tmp_path, cache):
    written(tmp_path / "scene", plane(-0.3, 0.0, 0.3))
    few_points(tmp_path / "scene", 10_000)
    assert len(load_scene(SceneOptions(str(tmp_path / "scene"))).points.positions) == 10_000
    assert not cache.exists()


def test_where_a_dense_start_finds_nothing_random_points_are_taken_and_it_is_not_tried_again(tmp_path, cache):
    size = {"width": 64, "height": 48, "focal": 60.0}
    inward = [looking(x, turn=-0.2 * x, **size) for x in (-0.3, 0.3)]
    written(
        tmp_path / "scene", [View(f"{i}", camera, torch.full((3, 48, 64), 0.3 * i)) for i, camera in enumerate(inward)]
    )
    options = SceneOptions(str(tmp_path / "scene"))
    scene = load_scene(options)
    assert (scene.points.source, len(scene.points.positions)) == ("random", 10_000)
    assert re.search("10,000 random .*found only 0 points", str(scene))
    (file,) = cache.rglob("*.npz")
    assert len(np.load(file)["positions"]) == 0  # kept, for the next command loads the scene again
    for number, random in ((99, 10_000), (1_000, 0)):
        few_points(tmp_path / "scene", number)
        assert len(load_scene(options).points.positions) == number + random


@pytest.mark.parametrize(("photographs", "measured", "random"), [(11, 1_000, 0), (17, 99, 10_000)])
def test_of_many_photographs_a_dense_start_must_be_asked_for(tmp_path, cache, photographs, measured, random):
    written(tmp_path / "scene", plane(*np.linspace(-0.5, 0.5, photographs).tolist()))
    few_points(tmp_path / "scene", measured)
    scene = load_scene(SceneOptions(str(tmp_path / "scene"), test="none"))
    assert len(scene.points.positions) == measured + random
    assert not cache.exists()


@pytest.mark.slow
def test_of_sixteen_photographs_it_takes_the_place_of_random_points(tmp_path, cache):
    written(tmp_path / "scene", plane(*np.linspace(-0.5, 0.5, 16).tolist()))
    few_points(tmp_path / "scene", 99)
    assert "dense stereo, and 99 from" in str(load_scene(SceneOptions(str(tmp_path / "scene"), test="none")))


@pytest.mark.slow
def test_a_scene_folder_stays_as_it_is_and_the_points_are_kept_elsewhere(tmp_path, cache):
    root = tmp_path / "scene"
    written(root, plane(-0.3, 0.0, 0.3))
    before = sorted(root.rglob("*"))
    options = SceneOptions(str(root), points="dense")
    scene = load_scene(options)
    assert sorted(root.rglob("*")) == before
    assert scene.points.source == SOURCE
    assert scene.points.seen_by == {view.name for view in scene.train}
    assert "3 training photographs by dense" in str(scene)
    (file,) = cache.rglob("*.npz")
    kept = dict(np.load(file))
    np.savez(file, **{name: array[:-50] for name, array in kept.items()})
    assert torch.equal(load_scene(options).points.positions, scene.points.positions[:-50])
    file.write_bytes(b"damaged")
    assert torch.equal(load_scene(options).points.positions, scene.points.positions)


def test_a_cache_that_cannot_be_written_costs_only_time(cache):
    cache.write_text("no folder")
    size = {"width": 96, "height": 72, "focal": 90.0}
    views = [plane_view(name, looking(x, **size), 0.2) for name, x in (("a", -0.25), ("b", 0.25))]
    cloud, note = dense_start(views, PointCloud(torch.empty(0, 3), torch.empty(0, 3), "none"))
    assert f"{len(cloud.positions):,} measured on the 2 training" in note


def test_the_plan_tells_where_points_can_be_measured_and_what_it_was_worth():
    courtyard = synthetic_scene(width=40, height=30, points=100)

    def item(scene):
        return {item.name: item for item in make_plan(scene, TrainConfig()).items}["dense start"]

    assert "--points dense" in item(courtyard).reason
    assert "3 of 3 training views" in item(courtyard).reason
    alone = replace(courtyard, train=courtyard.train[:1])
    assert "too few" in item(alone).reason
    assert "--points" not in item(alone).reason
    measured = replace(courtyard, points=replace(courtyard.points, source=SOURCE))
    assert item(measured).decision == "used"
    many = replace(courtyard.points, positions=torch.rand(10_000, 3), colors=torch.rand(10_000, 3))
    assert item(replace(courtyard, points=many)).reason == "10000 measured points are enough"


@pytest.mark.slow
def test_the_command_takes_a_dense_start(capsys):
    main(["plan", "synthetic", "--downscale", "4", "--points", "dense"])
    assert "the 3 training photographs" in capsys.readouterr().out
