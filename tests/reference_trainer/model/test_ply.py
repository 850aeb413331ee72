from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
import torch

from reference_trainer.model.gaussians import Gaussians
from reference_trainer.model.ply import load_ply, save_ply

BASE = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
BASE += ["rot_0", "rot_1", "rot_2", "rot_3"]


def make(n: int = 7, degree: int = 2, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    rest = (degree + 1) ** 2 - 1
    return Gaussians(draw(n, 3), draw(n, 3), draw(n, 4), 4 * draw(n), draw(n, 1, 3), draw(n, rest, 3))


def read_slowly(path: Path) -> tuple[list[str], list[dict[str, float]]]:
    """Return header lines and vertices of a little-endian float PLY, value by value with struct."""
    content = path.read_bytes()
    head, body = content.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    assert len(body) == 4 * count * len(names)
    rows = []
    for i in range(count):
        values = struct.unpack_from(f"<{len(names)}f", body, 4 * len(names) * i)
        rows.append(dict(zip(names, values, strict=True)))
    return lines, rows


def write_ascii_header(
    names: list[str], count: int, layout: str = "binary_little_endian", kind: str = "float"
) -> bytes:
    lines = ["ply", f"format {layout} 1.0", f"element vertex {count}", *(f"property {kind} {n}" for n in names)]
    return ("\n".join(lines) + "\nend_header\n").encode()


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    for (name, x), (_, y) in zip(a.named(), b.named(), strict=True):
        assert torch.equal(x, y), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 9])
def test_round_trip_is_exact(tmp_path, degree, n):
    gaussians = make(n, degree)
    save_ply(gaussians, tmp_path / "a.ply")
    model = load_ply(tmp_path / "a.ply")
    assert_equal(model.gaussians, gaussians)
    assert model.opacity_scale == 1.0


def test_file_seen_by_an_independent_reader(tmp_path):
    gaussians = make(5, 1)
    save_ply(gaussians, tmp_path / "a.ply")
    lines, rows = read_slowly(tmp_path / "a.ply")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    assert list(rows[0])[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert list(rows[0])[-8:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    for i, row in enumerate(rows):
        assert [row[k] for k in ("x", "y", "z")] == gaussians.means[i].tolist()
        assert [row[k] for k in ("nx", "ny", "nz")] == [0, 0, 0]
        assert [row[f"f_dc_{c}"] for c in range(3)] == gaussians.sh_dc[i, 0].tolist()
        assert row["opacity"] == gaussians.opacity_logits[i].item()
        assert [row[f"scale_{k}"] for k in range(3)] == gaussians.log_scales[i].tolist()
        assert [row[f"rot_{k}"] for k in range(4)] == gaussians.quaternions[i].tolist()
        for channel in range(3):
            for k in range(3):
                assert row[f"f_rest_{channel * 3 + k}"] == gaussians.sh_rest[i, k, channel].item()


def test_padding_to_a_higher_degree(tmp_path):
    gaussians = make(4, 1)
    save_ply(gaussians, tmp_path / "a.ply", pad_to_degree=3)
    padded = load_ply(tmp_path / "a.ply").gaussians
    assert padded.sh_degree == 3
    assert torch.equal(padded.sh_rest[:, :3], gaussians.sh_rest)
    assert not padded.sh_rest[:, 3:].any()
    save_ply(make(4, 2), tmp_path / "b.ply", pad_to_degree=1)
    assert load_ply(tmp_path / "b.ply").gaussians.sh_degree == 2


@pytest.mark.parametrize("p", [0.2, 0.5, 0.999, 1 - 1e-13])
def test_baked_opacities(tmp_path, p):
    gaussians = make(50)
    save_ply(gaussians, tmp_path / "a.ply", bake_p=p)
    model = load_ply(tmp_path / "a.ply")
    assert model.opacity_scale == pytest.approx(1 - p, abs=1e-12)
    expected = (1 - p) * torch.sigmoid(gaussians.opacity_logits.double())
    torch.testing.assert_close(model.gaussians.opacities.double(), expected, atol=1e-6, rtol=1e-5)
    for name in ("means", "log_scales", "quaternions", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(model.gaussians, name), getattr(gaussians, name))


def test_baked_opacities_at_the_extremes(tmp_path):
    logits = torch.tensor([-80.0, -30.0, 30.0, 80.0, float("inf"), float("-inf")])
    gaussians = replace(make(6), opacity_logits=logits)
    save_ply(gaussians, tmp_path / "a.ply", bake_p=0.2)
    baked = load_ply(tmp_path / "a.ply").gaussians.opacity_logits
    # A tiny opacity is multiplied by 0.8, that is its logit falls by log(1.25); an opaque one becomes exactly 0.8.
    shift = torch.tensor(1.25).log()
    torch.testing.assert_close(baked[:2], logits[:2] - shift, atol=0, rtol=1e-6)
    torch.testing.assert_close(baked[2:5].sigmoid(), torch.full((3,), 0.8))
    assert baked[5] == float("-inf")


def test_the_mark_is_a_comment_others_can_read(tmp_path):
    save_ply(make(), tmp_path / "a.ply", bake_p=0.2)
    assert "comment ca_reg opacity_scaled_by 0.8" in read_slowly(tmp_path / "a.ply")[0]
    save_ply(make(), tmp_path / "b.ply", bake_p=0.0)
    assert load_ply(tmp_path / "b.ply").opacity_scale == 1.0
    assert_equal(load_ply(tmp_path / "b.ply").gaussians, make())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_other_opacities_are_stored_and_marked(tmp_path, dtype):
    gaussians = make(50)
    opacities = torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    opacities[:2] = torch.tensor([0.0, 1.0])
    save_ply(gaussians, tmp_path / "a.ply", opacities=opacities.requires_grad_())
    lines, rows = read_slowly(tmp_path / "a.ply")
    assert "comment ca_reg opacity_for_rendering" in lines
    logits = torch.tensor([row["opacity"] for row in rows], dtype=torch.float64)
    torch.testing.assert_close(1 / (1 + torch.exp(-logits)), opacities.detach().double(), rtol=0, atol=1e-6)
    loaded = load_ply(tmp_path / "a.ply")
    assert (loaded.for_rendering, loaded.opacity_scale) == (True, 1.0)
    assert torch.equal(loaded.gaussians.opacity_logits, logits.float())
    assert_equal(replace(loaded.gaussians, opacity_logits=gaussians.opacity_logits), gaussians)


@pytest.mark.parametrize("bake_p", [None, 0.2])
def test_without_other_opacities_there_is_no_such_mark(tmp_path, bake_p):
    save_ply(make(), tmp_path / "a.ply", bake_p=bake_p)
    assert not load_ply(tmp_path / "a.ply").for_rendering


@pytest.mark.parametrize("layout", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize(("kind", "code"), [("float", "f"), ("double", "d"), ("float64", "d")])
def test_any_order_type_and_layout(tmp_path, layout, kind, code):
    names = ["extra", *reversed(BASE), *(f"f_rest_{i}" for i in reversed(range(9)))]
    rows = [[float(100 * i + j) / 64 for j in range(len(names))] for i in range(3)]
    if layout == "ascii":
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in layout else ">"
        body = b"".join(struct.pack(f"{order}{len(names)}{code}", *row) for row in rows)
    path = tmp_path / "a.ply"
    path.write_bytes(write_ascii_header(names, 3, layout, kind) + body)
    gaussians = load_ply(path).gaussians
    column = {name: torch.tensor([row[j] for row in rows]) for j, name in enumerate(names)}
    assert torch.equal(gaussians.means, torch.stack([column[k] for k in "xyz"], 1))
    assert torch.equal(gaussians.opacity_logits, column["opacity"])
    assert torch.equal(gaussians.quaternions[:, 0], column["rot_0"])
    assert torch.equal(gaussians.sh_rest[:, 1, 2], column["f_rest_7"])


def test_windows_line_ends_and_later_elements(tmp_path):
    header = write_ascii_header(BASE, 1).replace(
        b"end_header", b"element face 0\nproperty list uchar int v\nend_header"
    )
    path = tmp_path / "a.ply"
    path.write_bytes(header.replace(b"\n", b"\r\n") + struct.pack("<14f", *range(14)))
    assert load_ply(path).gaussians.means.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("name", BASE)
def test_a_missing_property_is_named(tmp_path, name):
    names = [other for other in BASE if other != name]
    path = tmp_path / "a.ply"
    path.write_bytes(write_ascii_header(names, 1) + bytes(4 * len(names)))
    with pytest.raises(ValueError, match=f"lack {name}"):
        load_ply(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY"),
        (b"\x89PNG\r\n", "not a PLY"),
        (b"ply\n" + b"comment x\n" * 10_000, "first 65536 bytes"),
        (b"ply\n" + b"x" * 200_000, "first 65536 bytes"),
        (write_ascii_header(BASE, 1), "cut short: 1 vertices need 56 bytes .* 0 "),
        (write_ascii_header(BASE, 10**15) + bytes(56), "cut short"),
        (write_ascii_header(BASE, 10**15, "ascii") + b"1 2 3\n", "cut short"),
        (write_ascii_header(BASE, -1), "count"),
        (write_ascii_header(BASE, 1, "binary_middle_endian"), "format must be"),
        (write_ascii_header(BASE, 1, kind="quad") + bytes(56), "unknown type"),
        (write_ascii_header([*BASE, "x"], 1) + bytes(60), "repeated name"),
        (write_ascii_header([*BASE, "f_rest_1"], 1) + bytes(60), "lack f_rest_0"),
        (write_ascii_header([*BASE, "f_rest_0"], 1) + bytes(60), "has 1 f_rest"),
        (write_ascii_header(BASE, 1, "ascii") + b"1 2 3 4 5 6 7 8 9 0 1 2 3 four\n", "numbers each"),
        (write_ascii_header(BASE, 1, "ascii") + b"1.000000000000000000000000000 2\n", "numbers each"),
        (write_ascii_header(BASE, 1) + struct.pack("<14f", float("nan"), *range(13)), "not finite in means"),
        (write_ascii_header(BASE, 1, kind="double") + struct.pack("<14d", 1e300, *range(13)), "not finite in means"),
        (b"ply\nformat ascii 1.0\nelement face 1\nelement vertex 1\nend_header\n", "first element"),
        (write_ascii_header(BASE, 1).replace(b"float x", b"list uchar int x"), "list properties"),
        (
            write_ascii_header(BASE, 1).replace(b"element", b"comment ca_reg opacity_scaled_by 1.5\nelement")
            + bytes(56),
            "factor in",
        ),
    ],
)
def test_damaged_files(tmp_path, content, message):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_ply(path)


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.KSPLAT", "a.sog"])
def test_compressed_formats_say_what_to_do(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x1f\x8b anything")
    with pytest.raises(ValueError, match=r"compressed format.*PLY"):
        load_ply(tmp_path / name)


def test_a_compressed_ply_says_what_to_do(tmp_path):
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", "property float min_x"]
    lines += ["element vertex 1", "property uint packed_position", "end_header", ""]
    (tmp_path / "a.compressed.ply").write_bytes("\n".join(lines).encode() + bytes(8))
    with pytest.raises(ValueError, match=r"compressed PLY.*made from"):
        load_ply(tmp_path / "a.compressed.ply")


def write_with_filter(path: Path, gaussians: Gaussians, width: float) -> None:
    save_ply(gaussians, path)
    head, body = path.read_bytes().split(b"end_header\n")
    rows = torch.frombuffer(bytearray(body), dtype=torch.float32).reshape(len(gaussians), -1)
    rows = torch.cat([rows, torch.full((len(gaussians), 1), width)], dim=1)
    path.write_bytes(head + b"property float filter_3D\nend_header\n" + rows.numpy().tobytes())


@pytest.mark.parametrize("width", [0.02, 1.0])
def test_the_filter_of_mip_splatting_blurs_every_gaussian(tmp_path, width):
    gaussians = make(6, 1)
    write_with_filter(tmp_path / "mip.ply", gaussians, width)
    loaded = load_ply(tmp_path / "mip.ply").gaussians
    # A Gaussian and an isotropic one are products over the axes: the blur is a sum along each, at 0 and at one width.
    scales, wide = gaussians.scales.double()[..., None], loaded.scales.double()[..., None]
    step = width / 50
    at = torch.arange(-500, 501, dtype=torch.float64) * step
    kernel = torch.exp(-((at / width) ** 2) / 2)
    kernel /= kernel.sum()
    peaks = (torch.exp(-((at / scales) ** 2) / 2) * kernel).sum(dim=2)
    beside = (torch.exp(-(((wide - at) / scales) ** 2) / 2) * kernel).sum(dim=2)
    torch.testing.assert_close(beside / peaks, torch.full_like(peaks, -0.5).exp(), rtol=1e-5, atol=0)
    expected = torch.sigmoid(gaussians.opacity_logits.double()) * peaks.prod(dim=1)
    torch.testing.assert_close(loaded.opacities.double(), expected, rtol=1e-5, atol=0)
    assert_equal(replace(loaded, log_scales=gaussians.log_scales, opacity_logits=gaussians.opacity_logits), gaussians)


def test_a_filter_of_no_width_changes_nothing(tmp_path):
    gaussians = replace(make(4), opacity_logits=torch.tensor([-80.0, 0.5, 80.0, float("inf")]))
    write_with_filter(tmp_path / "mip.ply", gaussians, 0.0)
    loaded = load_ply(tmp_path / "mip.ply").gaussians
    torch.testing.assert_close(loaded.opacity_logits, gaussians.opacity_logits, rtol=1e-6, atol=0)
    assert_equal(replace(loaded, opacity_logits=gaussians.opacity_logits), gaussians)


def test_a_filter_that_is_no_width_is_an_error(tmp_path):
    write_with_filter(tmp_path / "mip.ply", make(2), -1.0)
    with pytest.raises(ValueError, match="not finite in log_scales"):
        load_ply(tmp_path / "mip.ply")


def test_a_cut_anywhere_is_an_error(tmp_path):
    save_ply(make(3, 1), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    for length in range(0, len(content), 7):
        (tmp_path / "b.ply").write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"not a PLY|cut short"):
            load_ply(tmp_path / "b.ply")


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save_ply(make(3), path)
    before = path.read_bytes()

    def fail(self, content):
        self.open("wb").close()
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        save_ply(make(4), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"bake_p": 1.0}, "bake_p"),
        ({"bake_p": -0.1}, "bake_p"),
        ({"pad_to_degree": 4}, "pad_to_degree"),
        ({"opacities": torch.rand(6)}, r"opacities must have shape \(7,\)"),
        ({"opacities": torch.full((7,), 1.5)}, "values from 1.5 to 1.5"),
        ({"opacities": torch.full((7,), torch.nan)}, "values from nan to nan"),
        ({"opacities": torch.rand(7), "bake_p": 0.2}, "give one of them"),
    ],
)
def test_wrong_arguments(tmp_path, keywords, message):
    with pytest.raises(ValueError, match=message):
        save_ply(make(), tmp_path / "a.ply", **keywords)


def test_parameters_with_gradients_are_saved(tmp_path):
    gaussians = make().map(lambda x: x.requires_grad_())
    save_ply(gaussians, tmp_path / "a.ply", bake_p=0.2)
    assert len(load_ply(tmp_path / "a.ply").gaussians) == 7


@pytest.mark.data
@pytest.mark.parametrize("name", ["plant_20k_sh3zero.ply", "spot_10k_mesh2splat_sh3zero.ply"])
def test_models_of_other_people(data_root, tmp_path, name):
    path = data_root / "splats" / name
    model = load_ply(path)
    _, rows = read_slowly(path)
    assert len(model.gaussians) == len(rows)
    assert model.gaussians.sh_degree == 3
    assert model.opacity_scale == 1.0
    for i in (0, len(rows) // 2, len(rows) - 1):
        assert model.gaussians.means[i].tolist() == [rows[i][k] for k in ("x", "y", "z")]
        assert model.gaussians.quaternions[i].tolist() == [rows[i][f"rot_{k}"] for k in range(4)]
    save_ply(model.gaussians, tmp_path / "copy.ply")
    assert (tmp_path / "copy.ply").stat().st_size == path.stat().st_size
    assert_equal(load_ply(tmp_path / "copy.ply").gaussians, model.gaussians)


@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
def test_random_damage_is_read_or_refused(tmp_path, layout):
    random = Random(0)
    body = struct.pack("<14f", *range(14)) if layout != "ascii" else b"0 1 2 3 4 5 6 7 8 9 10 11 12 13\n"
    content = write_ascii_header(BASE, 1, layout) + body
    path = tmp_path / "a.ply"
    refusals, read = [], 0
    for _ in range(400):
        damaged = bytearray(content)
        for _ in range(random.randint(1, 3)):
            damaged[random.randrange(len(damaged))] = random.randrange(256)
        path.write_bytes(damaged)
        try:
            gaussians = load_ply(path).gaussians
        except ValueError as error:
            refusals.append(str(error))
        else:
            read += 1
            assert all(x.dtype == torch.float32 and x.shape[0] == len(gaussians) for _, x in gaussians.named())
    assert read > 0
    assert refusals
    assert all(str(path) in message for message in refusals)


def test_the_name_of_a_module_in_other_letters_does_not_stop_a_model_from_being_written(tmp_path):
    """The header is ASCII, which other programs rely on."""
    save_ply(make(), tmp_path / "a.ply", regularizer="m\u00f6dul:Drop(0.3)", step=7)
    lines, _ = read_slowly(tmp_path / "a.ply")
    assert r"comment ca_reg trained_with 7 m\xf6dul:Drop(0.3)" in lines
    assert load_ply(tmp_path / "a.ply").step == 7
