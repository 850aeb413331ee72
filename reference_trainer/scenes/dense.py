"""A dense start: points measured on the training photographs alone, by multi-view stereo on the processor."""

from __future__ import annotations

import hashlib
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reference_trainer.camera import Camera
from reference_trainer.files import replacing
from reference_trainer.progress import progress_bar
from reference_trainer.scenes.images import resize_image
from reference_trainer.scenes.scene import PointCloud, View

__all__ = [
    "ENOUGH", "SOURCE", "THIN", "dense_points", "dense_start", "made_unasked", "matched_size", "source_views",
]  # fmt: skip

SOURCE = "dense stereo"
"""What such a cloud names as its `source`."""

COUNT = 15_000
MIN_POINTS = 1_000
THIN = 1_000  # measured points; to fewer, random ones are added where a dense start cannot be
ENOUGH = 10_000  # measured points, to which none are added unasked
MOST, MOST_IF_THIN = 10, 16  # photographs to measure on unasked: each takes five seconds of a core
PIXELS = 200_000  # larger photographs are made smaller: more pixels take longer and add no points
ENLARGED = 1.4  # and smaller ones larger: the windows, of a fixed number of pixels, then cover finer detail
NEARER, FARTHER = 0.8, 3.0  # ends of the sweep, by the depths of measured points: what lies behind them may be far
SEARCHED = 1.6  # its far end by the depths of the coarse search, which has looked behind them
SPACING, PLANES = 0.7, 192  # pixels of motion from plane to plane, and their largest number
COARSE = 12_000  # pixels of the photographs that find the range of depth where no points tell it
SOURCES = 2
ANGLES, USUAL = (0.5, 60.0), 12.0  # degrees between the rays that meet in a point: those that can be matched, the best
OVERLAP = 0.25
GUIDES = 50  # points that a view must see to tell its range of depth
ROUNDS = 3
SIDE = 4  # pixels over which the sweep's depths give a slope
NEAR, ALIKE = 1.5, 0.02  # pixels and share of the inverse depth within which two photographs agree
BAR = {"desc": "points", "unit": "photo", "delay": 2.0, "leave": False}
SMALL, LARGE = 0.03, 0.35  # costs of a step between planes, where a correlation of -1 costs 1


class _Image(NamedTuple):
    """A photograph as the loops need it: gray around 0, its colors, its camera, and where it shows anything."""

    gray: NDArray[np.float32]
    colors: Tensor
    camera: Camera
    solid: Tensor


class _Range(NamedTuple):
    """The depths that a sweep goes through, and the one at which source views are chosen."""

    near: float
    far: float
    usual: float


class _Depths(NamedTuple):
    """Slanted planes (3, H, W) of a picture's pixels, their correlations (H, W), and the sources they come from."""

    planes: NDArray[np.float32]
    scores: NDArray[np.float32]
    sources: list[int]


def made_unasked(points: int, photographs: int) -> bool:
    """Return whether a training on so many photographs, with so many measured points, begins with a dense start.

    Example:
        >>> made_unasked(500, photographs=16), made_unasked(5_000, photographs=16), made_unasked(5_000, photographs=3)
        (True, False, True)
    """
    return points < ENOUGH and photographs <= (MOST_IF_THIN if points < THIN else MOST)


def dense_points(views: Sequence[View], guide: PointCloud | None = None, *, count: int = COUNT) -> PointCloud:
    """Measure points on the surfaces that two or more training photographs show.

    A plane sweep with semi-global aggregation gives every photograph a depth map, slanted windows refine it, and only
    depths on which photographs agree become points, one per voxel whose size grows with the distance from the cameras.
    Of photographs that are the same, only the first is looked at. The result depends on nothing but the arguments.

    Args:
        views: the training views; their `depth`, if known, is not looked at.
        guide: points that tell the range of depth; without them, or where a view sees too few, it is searched for
            between the depths at which the cameras see the same.
        count: the largest number of points.

    Raises:
        ValueError: if there are fewer than 2 different photographs, no two cameras see the same from different places,
            or fewer than 1,000 points are found.
        ImportError: if numba is missing.
    """
    views, about = _different(views)
    if about:
        logging.getLogger(__name__).info("dense start: %s", about)
    return _enough(_measure(views, guide, count), views, count)


def _different(views: Sequence[View]) -> tuple[list[View], str]:
    """Return the views whose photographs differ from those before them, and a note on the others.

    What cannot be measured on is refused before the work.
    """
    try:
        import reference_trainer.compiled.stereo as _  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "a dense start needs numba: pip install 'ca_reg[trainer]', or choose other points."
        ) from error
    different, same = list[View](), list[str]()
    for view in views:
        original = next((other for other in different if _alike(other.image, view.image)), None)
        if original is None:
            different.append(view)
        else:
            same.append(f"{view.name} shows the same as {original.name} and is left out")
    about = "; ".join(same)
    if len(different) < 2:
        raise ValueError(
            f"a dense start needs at least 2 different training photographs, got {len(different)}"
            f"{f' ({about})' * bool(about)}: choose other points."
        )
    return different, about


def _alike(one: Tensor, other: Tensor) -> bool:
    """Whether two pictures are the same but for what saving one again changes."""
    return one.shape == other.shape and float((one - other).abs().mean()) < 1 / 255


def _enough(cloud: PointCloud, views: Sequence[View], count: int) -> PointCloud:
    """Return the cloud, if its points are enough to start from."""
    if len(cloud.positions) < min(MIN_POINTS, count // 2):
        raise ValueError(
            f"a dense start found only {len(cloud.positions)} points on which the {len(views)} training photographs "
            f"agree, at least {MIN_POINTS:,} are needed: they lack texture or overlap, or the cameras are wrong. "
            "Choose other points."
        )
    return cloud


def _measure(views: Sequence[View], guide: PointCloud | None, count: int) -> PointCloud:
    """Return at most so many points on which the photographs agree, which may be none."""
    images = [_image(view, PIXELS) for view in views]
    cameras = [image.camera for image in images]
    ranges = [_guided(camera, guide) for camera in cameras]
    if None in ranges:
        small = [_image(view, COARSE) for view in views]
        found = _agreed(small, _depth_maps(small, [_visible(cameras, i) for i in range(len(cameras))]))
        cloud = None if found is None else PointCloud(found[0], found[1], "")
        ranges = [
            _guided(camera, cloud, SEARCHED) if known is None else known
            for camera, known in zip(cameras, ranges, strict=True)
        ]
    agreed = _agreed(images, _depth_maps(images, ranges)) or (torch.empty(0, 3), torch.empty(0, 3), torch.empty(0))
    positions, colors, confidence = _thinned(*agreed, cameras, count)
    return PointCloud(positions, colors, SOURCE, frozenset(view.name for view in views), confidence)


def dense_start(views: Sequence[View], measured: PointCloud) -> tuple[PointCloud, str]:
    """Return `dense_points` together with the points that are measured already, and a note on them.

    Those already measured tell the range of depth, and lie where the photographs have too little texture for stereo.
    The dense ones are kept in the user's cache folder, for every command loads its scene: in ``ca_reg`` of
    ``$XDG_CACHE_HOME``, else of ``~/.cache``, named by a hash of all that they depend on. Errors are those of
    `dense_points`.
    """
    views, about = _different(views)
    dense = _enough(_cached(views, measured), views, COUNT)
    assert dense.confidence is not None
    number, more = len(dense.positions), len(measured.positions)
    note = f"initial points: {number:,} measured on the {len(views)} training photographs by dense stereo"
    note += f" ({about})" * bool(about)
    if more == 0:
        return dense, note
    cloud = replace(
        dense,
        positions=torch.cat([dense.positions, measured.positions]),
        colors=torch.cat([dense.colors, measured.colors]),
        seen_by=None if measured.seen_by is None else measured.seen_by | (dense.seen_by or frozenset()),
        confidence=torch.cat([dense.confidence, torch.ones(more)]),
    )
    return cloud, f"{note}, and {more:,} from {measured.source}"


def _cached(views: Sequence[View], guide: PointCloud) -> PointCloud:
    """Return what `_measure` finds, which is kept in the cache folder even if it is too little."""
    names = frozenset(view.name for view in views)
    digest = hashlib.sha256(guide.positions.numpy().tobytes())
    for code in (Path(__file__), Path(__file__).parents[1] / "compiled/stereo.py"):
        digest.update(code.read_bytes())
    for view in views:
        camera = view.camera
        inner = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height])
        for layer in (inner, camera.world_to_camera, view.image, view.alpha):
            digest.update(b"none" if layer is None else layer.contiguous().numpy().tobytes())
    path: Path | None = None
    try:
        path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "ca_reg", f"{digest.hexdigest()}.npz")
        with np.load(path) as cached:
            parts = [torch.from_numpy(cached[name]) for name in ("positions", "colors", "confidence")]
        return PointCloud(parts[0], parts[1], SOURCE, names, parts[2])
    except Exception:  # nothing is cached, or a damaged file, which may raise anything
        pass
    cloud = _measure(views, guide, COUNT)
    assert cloud.confidence is not None
    made = [part.numpy() for part in (cloud.positions, cloud.colors, cloud.confidence)]
    try:
        if path is not None:
            with replacing(path) as place, place.open("wb") as file:
                np.savez(file, positions=made[0], colors=made[1], confidence=made[2])
    except OSError as error:  # costs the next command half a minute
        logging.getLogger(__name__).info("the points of the dense start are not kept: %s", error)
    return cloud


def source_views(cameras: Sequence[Camera], number: int, depth: float) -> list[int]:
    """Return the cameras that match best what one of them sees at a depth: up to two, the best first.

    Each sees at least a quarter of it, from a direction 0.5 to 60 degrees away, at best 12: closer directions measure
    depth poorly, and from further away surfaces look different. Of two in one place, as of a photograph that is there
    twice, the second would confirm whatever the first one says: only one is taken.
    """
    points = _grid(cameras[number], torch.tensor([depth]))[0]
    worth = []
    for other, camera in enumerate(cameras):
        seen, angles = _shared(points, cameras[number], camera)
        if other != number and seen >= OVERLAP and ANGLES[0] <= angles <= ANGLES[1]:
            worth.append((seen * math.exp(-(math.log(angles / USUAL) ** 2)), other))
    chosen = list[int]()
    for _, other in sorted(worth, key=lambda pair: (-pair[0], pair[1])):
        if all(_shared(points, cameras[other], cameras[taken])[1] >= ANGLES[0] for taken in chosen):
            chosen.append(other)
    return chosen[:SOURCES]


def matched_size(width: int, height: int, most: int = PIXELS) -> tuple[int, int]:
    """Return the size at which photographs of this size are matched; the time grows with its pixels.

    Example:
        >>> matched_size(1000, 800), matched_size(200, 100)
        ((500, 400), (280, 140))
    """
    factor = min(ENLARGED, math.sqrt(most / (width * height)))
    return max(2, round(width * factor)), max(2, round(height * factor))


def _grid(camera: Camera, depths: Tensor) -> Tensor:
    """Return the points (D, 49, 3) at 7 x 7 pixels of a picture at depths (D,)."""
    steps = (torch.arange(7) + 0.5) / 7
    pixels = torch.cartesian_prod(steps * camera.width, steps * camera.height)
    return camera.lift(pixels.expand(len(depths), -1, -1), depths[:, None].expand(-1, 49))


def _shared(points: Tensor, one: Camera, other: Camera) -> tuple[float, float]:
    """Return the share of points (N, 3) that another camera sees, and the median angle between both rays, degrees."""
    seen = other.inside(*other.project(points))
    rays = [torch.nn.functional.normalize(points - camera.position, dim=1) for camera in (one, other)]
    # From the chord: the cosine of a small angle is 1 in float32.
    angle = 2 * ((rays[0] - rays[1]).norm(dim=1) / 2).clamp(max=1).asin().median()
    return float(seen.float().mean()), math.degrees(float(angle))


def _visible(cameras: Sequence[Camera], number: int) -> _Range | None:
    """Return the range of depths at which a camera shares what it sees with another one, from the cameras alone."""
    camera, good = cameras[number], []
    for other in cameras:
        apart = float((other.position - camera.position).norm())
        depths = torch.logspace(-1, 3, 81) * apart
        if apart > 0:
            for depth, points in zip(depths.tolist(), _grid(camera, depths), strict=True):
                seen, angle = _shared(points, camera, other)
                good += [depth] * (seen >= OVERLAP and ANGLES[0] <= angle <= ANGLES[1])
    return _Range(min(good), max(good), math.sqrt(min(good) * max(good))) if good else None


def _guided(camera: Camera, guide: PointCloud | None, farther: float = FARTHER) -> _Range | None:
    """Return the range of depths around the points that a camera sees, if they are enough to tell it.

    It ends at so many times the farthest depth. Source views are chosen at the median depth, however far the sweep
    goes: at the middle of a long one, photographs of a near thing share nothing.
    """
    if guide is None or len(guide.positions) < GUIDES:
        return None
    depths = camera.depths_of(guide.positions)
    if len(depths) < GUIDES:
        return None
    near, usual, far = depths.quantile(torch.tensor([0.01, 0.5, 0.99])).tolist()
    return _Range(NEARER * near, farther * far, usual)


def _image(view: View, most: int) -> _Image:
    """Prepare a photograph, made smaller to at most so many pixels."""
    height, width = view.image.shape[1:]
    size = matched_size(width, height, most)
    colors = view.image if size == (width, height) else resize_image(view.image, *size)
    gray = colors.mean(0).numpy()
    gray = gray - gray.mean()  # numpy's: the last bits of torch's mean depend on the number of threads
    solid = torch.ones(size[::-1]) if view.alpha is None else resize_image(view.alpha[None], *size, "bilinear")[0]
    return _Image(gray, colors, view.camera.resized(*size), solid > 0.5)


def _map(one: Camera, other: Camera) -> NDArray[np.float32]:
    """Return the map (3, 4) from a picture's pixels and inverse depths to another's homogeneous pixels."""
    inner = [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in (one, other)]
    poses = [c.world_to_camera.double().numpy() for c in (one, other)]
    relative = poses[1] @ np.linalg.inv(poses[0])
    turn = inner[1] @ relative[:3, :3] @ np.linalg.inv(inner[0])
    return np.concatenate([turn, inner[1] @ relative[:3, 3:]], 1).astype(np.float32)


def _stacked(layers: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Stack pictures (H, W), of sizes that may differ, and return their sizes (N, 2)."""
    sizes = np.array([layer.shape for layer in layers])
    high, wide = sizes.max(0)
    padded = [np.pad(layer, [(0, high - len(layer)), (0, wide - layer.shape[1])]) for layer in layers]
    return np.stack(padded), sizes


def _depth_maps(images: Sequence[_Image], ranges: Sequence[_Range | None]) -> list[_Depths | None]:
    """Measure the depth of every pixel of every picture that has a range and source views."""
    from reference_trainer.compiled import stereo
    from reference_trainer.compiled.threads import in_threads

    found: list[_Depths | None] = []
    cameras = [image.camera for image in images]
    every = zip(images, ranges, strict=True)
    for number, (image, span) in enumerate(progress_bar(iterable=every, total=len(images), **BAR)):
        sources = [] if span is None else source_views(cameras, number, span.usual)
        if span is None or not sources:
            found.append(None)
            continue
        gray, (height, width) = image.gray, image.gray.shape
        grays, sizes = _stacked([images[s].gray for s in sources])
        maps = np.stack([_map(image.camera, cameras[s]) for s in sources])
        inverses = _planes(image.camera, maps, span.near, span.far)
        pooled = torch.from_numpy(gray)[None]
        moments = [
            torch.nn.functional.avg_pool2d(x, 2 * r + 1, 1, r, count_include_pad=False)[0].numpy()
            for x in (pooled, pooled.square()) for r in (stereo.NARROW, stereo.WIDE)
        ]  # fmt: skip
        means = np.stack(moments[:2])
        variances = np.maximum(np.stack(moments[2:]) - means**2, 0)
        cost = np.empty((height, width, len(inverses)), np.float32)
        strips = -(-height // stereo.STRIP)
        given = gray, means, variances, grays, sizes, maps, inverses, cost
        in_threads(stereo.sweep, strips, *given, least=1)
        total = np.zeros_like(cost)
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            paths = height if dy == 0 else width if dx == 0 else height + width - 1
            steps = np.float32(SMALL), np.float32(LARGE)
            in_threads(stereo.aggregate, paths, dy, dx, gray, cost, total, *steps, least=16)
        planes, new = _chosen(total, inverses), np.empty((3, height, width), np.float32)
        del cost, total, given  # hundreds of megabytes, before the next photograph needs as much
        scores = np.empty((height, width), np.float32)
        for turn in range(ROUNDS):
            step = np.float32((inverses[1] - inverses[0]) / 2 ** (turn + 1))
            ends = np.array([inverses[0], inverses[-1]])
            reach, kept = (5, 3, 1)[turn], (ends, planes, new, scores)
            in_threads(stereo.refine, height, gray, grays, sizes, maps, step, reach, *kept, least=8)
            planes, new = new, planes
        found.append(_Depths(planes, scores, sources))
    return found


def _chosen(total: NDArray[np.float32], inverses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the inverse depths with the least costs (H, W, D), and slopes of 0: planes (3, H, W).

    Between the planes of the sweep a parabola has its least cost. At either end of the range the inverse depth is 0,
    for none: what lies beyond would match best there.
    """
    best = total.argmin(2)
    around = np.clip(best, 1, len(inverses) - 2)[:, :, None] + [-1, 0, 1]
    a, b, c = np.moveaxis(np.take_along_axis(total, around, 2), 2, 0)
    offset = np.clip(0.5 * (a - c) / np.maximum(a - 2 * b + c, 1e-6), -0.5, 0.5)
    planes = np.zeros((3, *best.shape), np.float32)
    inside = (best > 0) & (best < len(inverses) - 1)
    planes[0] = np.where(inside, inverses[best] + offset * (inverses[1] - inverses[0]), 0)
    for axis in (0, 1):
        # Of the slopes to both sides the smaller one: the other may cross an edge.
        padded = np.pad(planes[0], [(SIDE, SIDE) if axis == k else (0, 0) for k in (0, 1)], mode="edge")
        step = padded.take(range(SIDE, padded.shape[axis]), axis) - padded.take(range(padded.shape[axis] - SIDE), axis)
        size = best.shape[axis]
        left, right = step.take(range(size), axis), step.take(range(SIDE, size + SIDE), axis)
        planes[2 - axis] = np.where(np.abs(left) < np.abs(right), left, right) / SIDE
    return planes


def _planes(camera: Camera, maps: NDArray[np.float32], near: float, far: float) -> NDArray[np.float32]:
    """Return the inverse depths of the sweep's planes, from far to near; their number is a multiple of 16."""
    x, y = np.meshgrid((np.arange(5) + 0.5) / 5 * camera.width, (np.arange(5) + 0.5) / 5 * camera.height)
    ends = []
    for w in (1 / far, 1 / near):
        moved = maps @ np.stack([x.ravel(), y.ravel(), np.ones(25), np.full(25, w)])
        ends.append(moved[:, :2] / np.maximum(moved[:, 2:], 1e-6))
    motion = float(np.median(np.linalg.norm(ends[1] - ends[0], axis=1), axis=1).max())
    count = 16 * math.ceil(min(max(motion / SPACING, 32), PLANES) / 16)
    return np.linspace(1 / far, 1 / near, count, dtype=np.float32)


def _agreed(images: Sequence[_Image], maps: Sequence[_Depths | None]) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return positions, colors and confidences of all pixels whose depth other views confirm; None if there are none.

    The confidence is the correlation times the share of the source views that agree.
    """
    parts = []
    for image, depths in zip(images, maps, strict=True):
        if depths is None:
            continue
        known = torch.from_numpy(depths.planes[0]) > 0
        rows, columns = known.nonzero().unbind(1)
        pixels, inverse = torch.stack([columns, rows], 1) + 0.5, torch.from_numpy(depths.planes[0])[known]
        points, scores = image.camera.lift(pixels, 1 / inverse), torch.from_numpy(depths.scores)[known]
        agreeing, total = torch.zeros_like(inverse), inverse.clone()
        for source in depths.sources:
            other, camera = maps[source], images[source].camera
            if other is None:
                continue
            # To the source, from there at the source's own depth, and back: to the same pixel and the same depth?
            reached, depth = camera.project(points)
            same = camera.inside(reached, depth)
            cell = reached.where(same[:, None], 0).long()
            there, slope_x, slope_y = torch.from_numpy(other.planes)[:, cell[:, 1], cell[:, 0]]
            offset = reached - cell - 0.5
            same &= there > 0
            again, depth = image.camera.project(
                camera.lift(reached, 1 / (there + slope_x * offset[:, 0] + slope_y * offset[:, 1]))
            )
            same &= ((again - pixels).norm(dim=1) <= NEAR) & ((1 / depth - inverse).abs() <= ALIKE * inverse)
            agreeing += same
            total += (1 / depth).where(same, 0)
        kept = (agreeing > 1) & (scores > 0.5) | (agreeing > 0) & (scores > 0.8)
        fused = torch.zeros(known.shape)
        fused[known] = (total / (agreeing + 1)).where(kept, 0)
        kept = _supported(fused) & image.solid
        positions = image.camera.lift(kept.nonzero().flip(1) + 0.5, 1 / fused[kept])
        confidence = (scores.clamp(0, 1) * agreeing / len(depths.sources))[kept[known]]
        parts.append((positions, image.colors[:, kept].T, confidence))
    if not parts:
        return None
    positions, colors, confidence = (torch.cat(part) for part in zip(*parts, strict=True))
    return (positions, colors, confidence) if len(positions) else None


def _supported(inverse: Tensor) -> Tensor:
    """Return which pixels have, of 24 around them, at least 8 with an inverse depth within 2 %; 0 is none."""
    height, width = inverse.shape
    padded = torch.nn.functional.pad(inverse, (2, 2, 2, 2))
    around = torch.zeros_like(inverse, dtype=torch.int32)
    for y in range(5):
        for x in range(5):
            around += (padded[y : y + height, x : x + width] - inverse).abs() <= 0.02 * inverse
    return (around > 8) & (inverse > 0)


def _thinned(
    positions: Tensor, colors: Tensor, confidence: Tensor, cameras: Sequence[Camera], count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Keep the most confident point of every voxel, whose edge doubles with the distance to the nearest camera."""
    distance = torch.stack([(positions - camera.position).norm(dim=1) for camera in cameras]).amin(0)
    level = torch.floor(torch.log2(distance))
    best = torch.argsort(confidence, descending=True, stable=True)
    cells = torch.cat([positions / torch.exp2(level)[:, None], level[:, None]], 1)[best].double().numpy()

    def chosen(size: float) -> NDArray[Any]:
        places = np.floor(cells / [size, size, size, 1]).astype(np.int64)
        keys = places @ [1, 2**20, 2**40, 2**58]  # wraps, rarely meets
        return np.unique(keys, return_index=True)[1]

    low, high = 1e-4, 1.0  # too many and few enough, unless there are few anyway
    if len(chosen(low)) > count:
        for _ in range(12):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if len(chosen(middle)) > count else (low, middle)
        low = high
    kept = best[torch.from_numpy(np.sort(chosen(low)))]
    return positions[kept], colors[kept], confidence[kept]
