"""The workloads of the growth benchmark hold still what they promise to hold still."""

import pytest

from benchmarks.growth import calibrated, gaussians_per_pixel, growth_axes
from benchmarks.workloads import WORKLOADS, WorkloadSpec, covered_pairs


@pytest.fixture(scope="module")
def axes():
    return growth_axes(10_000)


def test_one_thing_grows_along_every_axis(axes):
    def column(name, attribute):
        return [getattr(spec, attribute) for spec in axes[name].points.values()]

    assert list(axes) == ["gaussians", "layers", "pixels", "lists"]
    assert list(axes["gaussians"].points) == column("gaussians", "gaussians") == [1_000, 3_000, 10_000]
    assert list(axes["layers"].points) == column("layers", "gaussians") == [1_000, 3_000, 10_000]
    assert len(set(column("layers", "base_scale"))) == 1
    pixels = [a * b for a, b in zip(column("pixels", "width"), column("pixels", "height"), strict=True)]
    assert list(axes["pixels"].points) == pixels == [side * side for side in (64, 128, 256, 512, 1024)]
    assert set(column("pixels", "gaussians")) == set(column("lists", "gaussians")) == {10_000}
    for name in ("gaussians", "pixels"):
        for spec in axes[name].points.values():
            assert gaussians_per_pixel(spec) == pytest.approx(45, rel=0.011)
    for x, spec in axes["lists"].points.items():
        assert gaussians_per_pixel(spec) == pytest.approx(x, rel=0.011)
    assert axes["layers"].points[10_000] == WORKLOADS["medium"]


def test_no_workload_is_larger_than_asked_for():
    sizes = {spec.gaussians for axis in growth_axes(2_000).values() for spec in axis.points.values()}
    assert max(sizes) == 2_000
    with pytest.raises(ValueError, match="1000 Gaussians, got 999"):
        growth_axes(999)


def test_a_sample_tells_of_all():
    spec = WorkloadSpec(20_000, 64, 48, 0.01)
    # The standard error of a mean over 10,000 Gaussians whose footprints vary by about their mean is 1 percent.
    assert gaussians_per_pixel(spec) == pytest.approx(covered_pairs(spec.make()) / (64 * 48), rel=0.04)


def test_the_standard_scales_are_found_again():
    for name in ("small", "medium"):
        w = WORKLOADS[name]
        found = calibrated(w.gaussians, w.width, w.height, 45.0)
        assert found.base_scale == pytest.approx(w.base_scale, rel=0.01)


@pytest.mark.parametrize("per_pixel", [0.01, 200.0])
def test_impossible_numbers_are_refused(per_pixel):
    with pytest.raises(ValueError, match=f"100 Gaussians on 32x32 pixels .*{per_pixel:g}"):
        calibrated(100, 32, 32, per_pixel)
