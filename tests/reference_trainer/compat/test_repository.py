"""The variant that a repository expects, read from sources in the forms that repositories have."""

from pathlib import Path

import pytest

from reference_trainer.compat.repository import MEMBERS, Interface, read_interface

HEAD = "from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer\n"
MAKE = "    rasterizer = GaussianRasterizer(raster_settings=settings)\n"
BASE = "diff_gaussian_rasterization"


def _repository(root: Path, renderer: str | None, scene: str = "") -> Path:
    for name, text in {"gaussian_renderer": renderer, "scene": scene}.items():
        (root / name).mkdir()
        if text is not None:
            (root / name / "__init__.py").write_text(text, encoding="utf-8")
    return root


SETTINGS = "    settings = GaussianRasterizationSettings({}=x)\n"
THREE = MAKE + "    image, radii, {} = rasterizer(means3D=x)\n"


@pytest.mark.parametrize(
    ("body", "outputs"),
    [
        (MAKE + "    image, radii = rasterizer(means3D=x)\n", 2),
        (SETTINGS.format("antialiasing") + THREE.format("depth_image"), "inverse-depth"),  # INRIA's own name for it
        (MAKE + "    (image, radii, depth, alpha) = rasterizer(\n        means3D=x)\n", 4),
        (MAKE.replace("rasterizer =", "r =") + "    image, radii = r(means3D=x)\n    a, b, c = other(x)\n", 2),
        (MAKE + "    a, b = rasterizer(x)\n    c, d = rasterizer(y)\n", 2),
        (SETTINGS.format("confidence") + MAKE + "    out = rasterizer(x)\n", 4),
        (SETTINGS.format("antialiasing") + MAKE + "    out = rasterizer(x)\n", "inverse-depth"),
    ],
)
def test_the_outputs_are_read_at_the_call(tmp_path, body, outputs):
    source = HEAD + "def render(x, y, settings):\n" + body
    assert read_interface(_repository(tmp_path, source)) == Interface(BASE, MEMBERS[outputs], False)


@pytest.mark.parametrize("third", ["depth", "inverse_depth", "is_used"])
def test_a_third_value_that_no_field_of_the_settings_tells_is_asked_for(tmp_path, third):
    root = _repository(tmp_path, HEAD + "def render(x, s):\n" + SETTINGS.format("sh_degree") + THREE.format(third))
    with pytest.raises(
        ValueError, match=r"third of three values .* 'depth' or 'inverse-depth', in the launcher --outputs"
    ):
        read_interface(root)
    with pytest.raises(ValueError, match="third of three values"):
        read_interface(root, outputs=3)
    assert read_interface(root, outputs="depth").members == ("depth",)
    assert read_interface(root, outputs="inverse-depth").members == ("inverse_depth",)


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
    with pytest.raises(ValueError, match=r"Give outputs=2, 4, .* in the launcher --outputs"):
        read_interface(root)
    assert read_interface(root, outputs=4).members == ("depth", "alpha")


def test_a_missing_renderer_is_named(tmp_path):
    root = _repository(tmp_path, None)
    with pytest.raises(ValueError, match=r"__init__\.py .* Give outputs"):
        read_interface(root)
    assert read_interface(root, outputs=2) == Interface(BASE, (), False)


@pytest.mark.parametrize("outputs", [0, 1, 5])
def test_other_numbers_are_refused(tmp_path, outputs):
    with pytest.raises(ValueError, match=f"outputs={outputs}"):
        read_interface(_repository(tmp_path, HEAD), outputs=outputs)


def test_the_absgs_package_is_told_by_its_name(tmp_path):
    source = HEAD.replace(BASE, BASE + "_abs") + "def render(x):\n" + MAKE + "    a, b, c = rasterizer(x)\n"
    root = _repository(tmp_path, source)
    assert read_interface(root) == Interface(BASE + "_abs", ("weights",), False)
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
