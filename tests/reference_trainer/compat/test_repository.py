"""The variant that a repository expects, read from sources in the forms that repositories have."""

from pathlib import Path

import pytest

from reference_trainer.compat.repository import Interface, read_interface

HEAD = "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
MAKE = "    rasterizer = GaussianRasterizer(raster_settings=settings)\n"
BASE = "diff_gaussian_rasterization"


def _repository(root: Path, renderer: str | None, scene: str = "") -> Path:
    for name, text in {"gaussian_renderer": renderer, "scene": scene}.items():
        (root / name).mkdir()
        if text is not None:
            (root / name / "__init__.py").write_text(text, encoding="utf-8")
    return root


@pytest.mark.parametrize(
    ("body", "outputs"),
    [
        (MAKE + "    image, radii = rasterizer(means3D=x)\n", 2),
        (MAKE + "    image, radii, inverse = rasterizer(means3D=x)\n", 3),
        (MAKE + "    (image, radii, depth, alpha) = rasterizer(\n        means3D=x)\n", 4),
        (MAKE.replace("rasterizer =", "r =") + "    image, radii = r(means3D=x)\n    a, b, c = other(x)\n", 2),
        (MAKE + "    a, b = rasterizer(x)\n    c, d = rasterizer(y)\n", 2),
        ("    settings = GaussianRasterizationSettings(confidence=1)\n" + MAKE + "    out = rasterizer(x)\n", 4),
        ("    settings = GaussianRasterizationSettings(antialiasing=0)\n" + MAKE + "    out = rasterizer(x)\n", 3),
    ],
)
def test_the_number_of_outputs_is_read_at_the_call(tmp_path, body, outputs):
    source = HEAD + "def render(x, y, settings):\n" + body
    assert read_interface(_repository(tmp_path, source)) == Interface(BASE, outputs, False)


@pytest.mark.parametrize(
    "body",
    [
        MAKE + "    out = rasterizer(means3D=x)\n",
        MAKE + "    image, *rest = rasterizer(means3D=x)\n",
        MAKE + "    a, b = rasterizer(x)\n    c, d, e = rasterizer(x)\n",
        "    a, b = rasterizer(x)\n",
    ],
)
def test_what_cannot_be_told_is_asked_for(tmp_path, body):
    root = _repository(tmp_path, HEAD + "def render(x, settings, rasterizer=None):\n" + body)
    with pytest.raises(ValueError, match="Give outputs=2, 3 or 4"):
        read_interface(root)
    assert read_interface(root, outputs=4).outputs == 4


def test_a_missing_renderer_is_named(tmp_path):
    root = _repository(tmp_path, None)
    with pytest.raises(ValueError, match=r"__init__\.py .* give outputs"):
        read_interface(root)
    assert read_interface(root, outputs=2) == Interface(BASE, 2, False)


@pytest.mark.parametrize("outputs", [0, 1, 5])
def test_other_numbers_are_refused(tmp_path, outputs):
    with pytest.raises(ValueError, match=f"outputs={outputs}"):
        read_interface(_repository(tmp_path, HEAD), outputs=outputs)


def test_the_absgs_package_is_told_by_its_name(tmp_path):
    source = HEAD.replace(BASE, BASE + "_abs") + "def render(x):\n" + MAKE + "    a, b, c = rasterizer(x)\n"
    root = _repository(tmp_path, source)
    assert read_interface(root) == Interface(BASE + "_abs", 3, False)
    with pytest.raises(ValueError, match="returns 3 values"):
        read_interface(root, outputs=4)


@pytest.mark.parametrize(
    ("scene", "indices"),
    [
        ("d = distCUDA2(points)", False),
        ("d = torch.clamp_min(distCUDA2(points), 1e-7)", False),
        ("d = torch.clamp_min(distCUDA2(points)[0], 1e-7)", True),
        ("d, near = distCUDA2(points)", True),
        ("d, _ = other(points)", False),
    ],
)
def test_whether_neighbours_come_with_numbers(tmp_path, scene, indices):
    assert read_interface(_repository(tmp_path, HEAD, scene), outputs=2).neighbor_indices is indices
