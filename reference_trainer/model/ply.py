"""Standard 3D Gaussian Splatting PLY files, in and out."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import logsigmoid

from reference_trainer.files import replacing
from reference_trainer.model.gaussians import Gaussians

__all__ = ["PlyModel", "load_ply", "save_ply"]

_SCALED = "ca_reg opacity_scaled_by"
_FOR_RENDERING = "ca_reg opacity_for_rendering"
_TRAINED_WITH = "ca_reg trained_with"
_LEARNED = "ca_reg_learned_"
_HEADER_LIMIT = 65_536  # bytes; a standard header has 1.6 kB, so more than this is not a header
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_OTHER_LINES = ("ply", "format", "obj_info", "end_header")  # of a header, besides those that are read
_COMPRESSED = (".spz", ".splat", ".ksplat", ".sog")
_CONVERT = "its values are rounded; give the PLY that it was made from, or convert it to one first (SuperSplat does)"
_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")


@dataclass(frozen=True)
class PlyModel:
    """What a PLY file holds.

    Args:
        gaussians: the Gaussians, float32 on the CPU, exactly as stored.
        opacity_scale: the factor that is already part of the stored opacities, 1.0 if none is: a model trained with
            dropout ``p`` and saved with ``bake_p=p`` has ``1 - p`` here and must not be scaled again.
        for_rendering: whether the file was saved with ``opacities=``: those in it are to be rendered as they are, and
            the plain ones cannot be had from it.
        regularizer: what the model was trained with, an expression of `ca_reg.regularizers.parse`, empty if the file
            does not say. It is text from a file: do not import what it names.
        step: of the training, 0 if the file does not say.
    """

    gaussians: Gaussians
    opacity_scale: float
    for_rendering: bool
    regularizer: str = ""
    step: int = 0


def save_ply(
    gaussians: Gaussians,
    path: str | Path,
    *,
    bake_p: float | None = None,
    opacities: Tensor | None = None,
    pad_to_degree: int | None = None,
    regularizer: str = "",
    step: int = 0,
) -> None:
    """Write Gaussians as a binary little-endian PLY of float32, the layout of the INRIA code, for any viewer.

    The file appears at once or not at all: it is written beside its place and moved there.

    Convention: opacities are logits, scales natural logarithms, ``rot_0`` is the real part of the quaternion, and
    ``f_rest_*`` runs through all coefficients of red, then of green, then of blue.

    Args:
        gaussians: what to write.
        path: the file; its folder must exist.
        bake_p: dropout rate in [0, 1) of the training, to store the opacities scaled by ``1 - bake_p`` as rendering
            needs them, for viewers that know nothing of dropout. A header comment records the factor. None or 0
            stores the opacities as they are.
        opacities: to store these instead, in [0, 1], shape (N,): what rendering needs where that is not one factor, as
            after opacity noise. A header comment records that they are not the plain ones.
        pad_to_degree: store at least this degree of spherical harmonics, 0 to 3, with zeros for the missing
            coefficients; many viewers read degree 3 only.
        regularizer: what the model was trained with, for a header comment; what regularizers learned per Gaussian is
            stored in properties of its own.
        step: of the training, likewise.

    Raises:
        ValueError: if ``bake_p``, ``opacities`` or ``pad_to_degree`` is out of range, or the first two are both given.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> gaussians = Gaussians.from_points(torch.rand(5, 3), torch.rand(5, 3), torch.full((5,), 0.1), sh_degree=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_ply(gaussians, f"{folder}/model.ply", bake_p=0.2, pad_to_degree=3)
        ...     model = load_ply(f"{folder}/model.ply")
        >>> model.opacity_scale, model.gaussians.sh_degree
        (0.8, 3)
        >>> bool(torch.allclose(model.gaussians.opacities, 0.8 * gaussians.opacities))
        True
    """
    if bake_p is not None and not 0 <= bake_p < 1:
        raise ValueError(f"bake_p is a dropout rate in [0, 1), got {bake_p}.")
    if pad_to_degree is not None and pad_to_degree not in (0, 1, 2, 3):
        raise ValueError(f"pad_to_degree must be 0, 1, 2 or 3, got {pad_to_degree}.")
    logits, comments = gaussians.opacity_logits.detach(), []
    if opacities is not None:
        if bake_p is not None:
            raise ValueError("bake_p scales the opacities of the Gaussians, opacities replaces them: give one of them.")
        logits, comments = _logits(opacities.detach(), len(gaussians)), [f"comment {_FOR_RENDERING}"]
    elif bake_p:
        # The decimal of 1 - 0.2 is written, not the neighbouring double that the subtraction gives.
        logits, comments = _scaled_logits(logits, 1 - bake_p), [f"comment {_SCALED} {round(1 - bake_p, 12)}"]
    if regularizer:
        comments.append(f"comment {_TRAINED_WITH} {step} {' '.join(regularizer.split())}")
    n, rest = len(gaussians), gaussians.sh_rest.detach().transpose(1, 2)  # [N, 3, K]
    padding = max(0, ((pad_to_degree or 0) + 1) ** 2 - 1 - rest.shape[2])
    rest = torch.cat([rest, rest.new_zeros(n, 3, padding)], dim=2).flatten(1)
    columns = [gaussians.means, torch.zeros_like(gaussians.means), gaussians.sh_dc.reshape(n, 3), rest]
    columns += [logits[:, None], gaussians.log_scales, gaussians.quaternions]
    columns += [x[:, None] for x in gaussians.learned.values()]
    table = torch.cat([column.detach().to("cpu", torch.float32) for column in columns], dim=1)
    rest_names = [f"f_rest_{index}" for index in range(rest.shape[1])]
    names = [*_MEANS, *_NORMALS, *_DC, *rest_names, "opacity", *_SCALES, *_ROTATIONS]
    names += [_LEARNED + name for name in gaussians.learned]
    header = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {n}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    with replacing(path) as place:
        place.write_bytes("\n".join(header).encode("ascii") + table.numpy().astype("<f4").tobytes())


def load_ply(path: str | Path) -> PlyModel:
    """Read Gaussians from a 3DGS PLY file: binary of either byte order or ASCII, properties in any order and type.

    Normals and unknown properties are ignored. Spherical harmonics may have any degree from 0 to 3. The 3D filter of
    Mip-Splatting changes scales and opacities, so a file with one is refused rather than drawn without it; compressed
    files are refused as well.

    Args:
        path: the file.

    Returns:
        The Gaussians in float32, and what their opacities already carry.

    Raises:
        ValueError: if the file is no such PLY, is shorter than its header says, or holds values that are not finite;
            the message says what is missing.
        OSError: if the file cannot be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        if path.suffix.lower() in _COMPRESSED:
            raise ValueError(f"{path} is a compressed format: {_CONVERT}.")
        header = _read_header(file, path)
        count, properties = header.count, header.properties
        rest = [f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in properties))]
        required = (*_MEANS, *_DC, *rest, "opacity", *_SCALES, *_ROTATIONS)
        missing = [name for name in required if name not in properties]
        if missing:
            raise ValueError(f"{path} is not a 3D Gaussian Splatting PLY: its vertices lack {', '.join(missing)}.")
        if "filter_3D" in properties:
            raise ValueError(
                f"{path} has scales and opacities that need its filter_3D (Mip-Splatting): give the fused PLY, which "
                "create_fused_ply.py of that code base writes."
            )
        if len(rest) not in (0, 9, 24, 45):
            raise ValueError(f"{path} has {len(rest)} f_rest properties; degrees 0 to 3 have 0, 9, 24 or 45.")
        rows = _read_rows(file, path, header)

    def columns(names: tuple[str, ...] | list[str]) -> Tensor:
        table = np.empty((count, len(names)), dtype=np.float32)
        with np.errstate(over="ignore"):  # becomes infinite, which is reported below
            for index, name in enumerate(names):
                table[:, index] = rows[name]
        return torch.from_numpy(table)

    gaussians = Gaussians(
        means=columns(_MEANS),
        log_scales=columns(_SCALES),
        quaternions=columns(_ROTATIONS),
        opacity_logits=columns(["opacity"])[:, 0],
        sh_dc=columns(_DC)[:, None, :],
        sh_rest=columns(rest).reshape(count, 3, len(rest) // 3).transpose(1, 2).contiguous(),
        learned={n.removeprefix(_LEARNED): columns([n])[:, 0] for n in properties if n.startswith(_LEARNED)},
    )
    # An opacity of exactly 0 or 1 has an infinite logit, which sigmoid takes: only NaN is wrong there.
    bad = [name for name, x in gaussians.named() if not torch.isfinite(x).all() and name != "opacity_logits"]
    bad += ["opacity_logits"] if bool(gaussians.opacity_logits.isnan().any()) else []
    if bad:
        raise ValueError(f"{path} holds values that are not finite in {', '.join(bad)}: remove those Gaussians first.")
    scale, for_rendering = _opacity_scale(header.comments, path), _FOR_RENDERING in header.comments
    return PlyModel(gaussians, scale, for_rendering, *_trained_with(header.comments, path))


def _logits(opacities: Tensor, count: int) -> Tensor:
    """Return the logits of so many opacities in [0, 1], in float64; infinite at the ends."""
    if opacities.shape != (count,) or not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise ValueError(
            f"opacities must have shape ({count},) and values in [0, 1], activated; got shape {tuple(opacities.shape)}"
            + (f" and values from {opacities.min():g} to {opacities.max():g}." if opacities.numel() else ".")
        )
    return torch.logit(opacities.double())


def _scaled_logits(logits: Tensor, factor: float) -> Tensor:
    """Return ``logit(factor * sigmoid(logits))`` in float64, without the cancellation of ``1 - x``."""
    logits = logits.double()
    opaque, clear = logsigmoid(logits), logsigmoid(-logits)
    denominator = torch.logaddexp(opaque + math.log1p(-factor), clear)  # 1 - f s = (1 - f) s + (1 - s)
    return opaque + math.log(factor) - denominator


@dataclass(frozen=True)
class _Header:
    """The format, the number of vertices, their properties with numpy types, comments, and if there is nothing else."""

    layout: str
    count: int
    properties: dict[str, str]
    comments: list[str]
    alone: bool


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Read everything up to the first vertex."""
    lines: list[str] = []
    while not lines or lines[-1] != "end_header":
        raw = file.readline(_HEADER_LIMIT)
        if file.tell() > _HEADER_LIMIT or not raw.endswith(b"\n") or (not lines and raw.strip() != b"ply"):
            raise ValueError(
                f"{path} is not a PLY file: expected a header from 'ply' to 'end_header' in the first "
                f"{_HEADER_LIMIT} bytes."
            )
        lines.append(raw.decode("latin-1").strip())
    layout, count, properties, elements, comments = "", -1, dict[str, str](), list[str](), list[str]()
    for line in lines:
        match line.split():
            case ["format", kind, "1.0"]:
                layout = kind
            case ["comment", *_]:
                comments.append(line.removeprefix("comment").strip())
            case ["element", name, number]:
                elements.append(name)
                if name == "vertex" and number.isdecimal() and len(number) < 19:
                    count = int(number)
            case ["property", kind, name] if elements[-1:] == ["vertex"]:
                if kind not in _TYPES or name in properties:
                    raise ValueError(f"{path}: the property line '{line}' has an unknown type or a repeated name.")
                properties[name] = _TYPES[kind]
            case ["property", "list", *_] if elements[-1:] == ["vertex"]:
                raise ValueError(f"{path}: vertices with list properties ('{line}') are not Gaussians.")
            case ["property", *_] if elements[-1:] != ["vertex"]:
                pass
            case [keyword, *_] if keyword not in _OTHER_LINES:
                raise ValueError(f"{path}: the header line '{line[:80]}' is not one of a PLY file.")
    if "chunk" in elements:
        raise ValueError(f"{path} is a compressed PLY: {_CONVERT}.")
    if layout not in (*_BYTE_ORDERS, "ascii"):
        raise ValueError(f"{path}: the format must be {', '.join(_BYTE_ORDERS)} or ascii (1.0), got '{layout}'.")
    if elements[:1] != ["vertex"] or "vertex" in elements[1:] or count < 0:
        raise ValueError(f"{path}: the first element must be 'vertex' with a count, got {elements[:8] or 'none'}.")
    return _Header(layout, count, properties, comments, alone=len(elements) == 1)


def _read_rows(file: BinaryIO, path: Path, header: _Header) -> NDArray[np.void]:
    """Read the vertices as a structured array; the file's size is compared first, so a false count costs nothing."""
    layout, count, properties = header.layout, header.count, header.properties
    available = os.fstat(file.fileno()).st_size - file.tell()
    binary = layout != "ascii"
    kinds = {name: _BYTE_ORDERS[layout] + kind if binary else "f8" for name, kind in properties.items()}
    dtype = np.dtype(list(kinds.items()))
    needed = count * (dtype.itemsize if binary else 2 * len(properties))  # a digit and a separator at least
    if needed > available + (not binary):
        raise ValueError(
            f"{path} is cut short: {count} vertices need {needed} bytes after the header, {available} are there."
        )
    if binary:
        if header.alone and available >= needed + dtype.itemsize:
            raise ValueError(f"{path} announces {count} vertices, {needed} bytes, but {available} follow the header.")
        return np.frombuffer(file.read(needed), dtype=dtype, count=count)
    table, line = np.empty((count, len(properties))), b"\n"
    try:
        for row in table:
            line = file.readline()
            words = line.split()
            if len(words) != len(row):
                raise ValueError(f"got {len(words)}")
            row[:] = np.array(words, np.float64)
        if not line.endswith(b"\n"):
            raise ValueError("the last line has no end")
    except ValueError as error:
        raise ValueError(f"{path}: the vertex lines do not hold {len(properties)} numbers each: {error}.") from error
    if header.alone and file.read().strip():
        raise ValueError(f"{path} announces {count} vertices, but more lines follow them.")
    return table.view(dtype)[:, 0]


def _opacity_scale(comments: list[str], path: Path) -> float:
    """Return the product of the recorded factors, 1.0 if there is none."""
    scale = 1.0
    for comment in comments:
        if comment.startswith(_SCALED):
            try:
                factor = float(comment.removeprefix(_SCALED))
            except ValueError:
                factor = float("nan")
            if not 0 < factor <= 1:
                raise ValueError(f"{path}: expected a factor in (0, 1] after '{_SCALED}', got '{comment}'.")
            scale *= factor
    return scale


def _trained_with(comments: list[str], path: Path) -> tuple[str, int]:
    """Return the recorded regularizers and the step."""
    for comment in comments:
        if comment.startswith(_TRAINED_WITH):
            step, _, regularizer = comment.removeprefix(_TRAINED_WITH).strip().partition(" ")
            if not (step.isdecimal() and len(step) < 10):
                raise ValueError(f"{path}: expected a step after '{_TRAINED_WITH}', got '{comment:.80}'.")
            return regularizer, int(step)
    return "", 0
