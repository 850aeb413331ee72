"""Reading and writing standard 3D Gaussian Splatting PLY files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from reference_trainer.files import replacing
from reference_trainer.model.gaussians import Gaussians
from reference_trainer.ply_files import CONVERT, read_ply

__all__ = ["PlyModel", "load_ply", "save_ply"]

_SCALED = "ca_reg opacity_scaled_by"
_FOR_RENDERING = "ca_reg opacity_for_rendering"
_TRAINED_WITH = "ca_reg trained_with"
_LEARNED = "ca_reg_learned_"
_COMPRESSED = (".spz", ".splat", ".ksplat", ".sog")
_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")


@dataclass(frozen=True)
class PlyModel:
    """What a PLY file holds.

    Args:
        gaussians: the Gaussians, float32 on the CPU, exactly as stored but for a ``filter_3D``, which is applied.
        opacity_scale: the factor that is already part of the stored opacities, 1.0 if none is: a model trained with
            dropout ``p`` and saved with ``bake_p=p`` has ``1 - p`` here and must not be scaled again.
        for_rendering: whether the file was saved with ``opacities=``: its opacities are to be rendered as they are, and
            the plain ones cannot be recovered.
        regularizer: what the model was trained with, as for `ca_reg.regularizers.parse`; empty if the file does not
            say. It is untrusted text: do not import what it names.
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

    The file is written atomically, see `replacing`.

    Convention: opacities are logits, scales natural logarithms, ``rot_0`` is the real part of the quaternion, and
    ``f_rest_*`` runs through all coefficients of red, then of green, then of blue.

    Args:
        gaussians: what to write.
        path: the file; its folder is created if missing.
        bake_p: dropout rate in [0, 1) of the training: opacities are stored scaled by ``1 - bake_p``, as rendering
            needs them, for viewers that know nothing of dropout. A header comment records the factor. None or 0
            stores the opacities as they are.
        opacities: stored instead of the model's, in [0, 1], shape (N,), where rendering needs other ones than a common
            factor gives, as after opacity noise. A header comment records that they are not the plain ones.
        pad_to_degree: store at least this degree of spherical harmonics, 0 to 3, with zeros for the missing
            coefficients; many viewers read degree 3 only.
        regularizer: what the model was trained with, for a header comment, in ASCII with other letters escaped. What
            regularizers learned per Gaussian is stored in separate properties.
        step: of the training, for the same comment.

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
        # The decimal of 1 - 0.2 is written, not the neighboring double that the subtraction gives.
        factor = torch.tensor(1 - bake_p, dtype=torch.float64)
        logits, comments = _scaled_logits(logits, factor), [f"comment {_SCALED} {1 - bake_p:.12g}"]
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
        place.write_bytes("\n".join(header).encode("ascii", "backslashreplace") + table.numpy().astype("<f4").tobytes())


def load_ply(path: str | Path) -> PlyModel:
    """Read Gaussians from a 3DGS PLY file: binary of either byte order or ASCII, properties of any order and type.

    Normals and unknown properties are ignored. Spherical harmonics may have any degree from 0 to 3. A ``filter_3D``
    is applied to scales and opacities, as the 3D smoothing filter of Mip-Splatting (arXiv:2311.16493) defines it: each
    Gaussian is convolved with a normalized isotropic one of that standard deviation. Compressed files are refused.

    Raises:
        ValueError: if the file is not such a PLY, disagrees with its header in length, or holds values that are not
            finite.
        OSError: if the file cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() in _COMPRESSED:
        raise ValueError(f"{path} is a compressed format: {CONVERT}.")
    vertices = read_ply(path)
    properties, columns = vertices.kinds, vertices.columns
    rest = [f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in properties))]
    required = (*_MEANS, *_DC, *rest, "opacity", *_SCALES, *_ROTATIONS)
    if missing := [name for name in required if name not in properties]:
        raise ValueError(f"{path} is not a 3D Gaussian Splatting PLY: its vertices lack {', '.join(missing)}.")
    if len(rest) not in (0, 9, 24, 45):
        raise ValueError(f"{path} has {len(rest)} f_rest properties; degrees 0 to 3 have 0, 9, 24 or 45.")

    log_scales, logits = columns(_SCALES), columns(["opacity"])[:, 0]
    if "filter_3D" in properties:
        wider = torch.logaddexp(2 * log_scales.double(), 2 * columns(["filter_3D"]).double().log()) / 2
        logits = _scaled_logits(logits, (log_scales - wider).sum(dim=1).exp()).float()  # by the ratio of the volumes
        log_scales = wider.float()
    gaussians = Gaussians(
        means=columns(_MEANS),
        log_scales=log_scales,
        quaternions=columns(_ROTATIONS),
        opacity_logits=logits,
        sh_dc=columns(_DC)[:, None, :],
        sh_rest=columns(rest).reshape(len(vertices.rows), 3, len(rest) // 3).transpose(1, 2).contiguous(),
        learned={
            name.removeprefix(_LEARNED): columns([name])[:, 0] for name in properties if name.startswith(_LEARNED)
        },
    )
    # An opacity of exactly 0 or 1 has an infinite logit, which sigmoid takes: only NaN is wrong there.
    bad = [name for name, x in gaussians.named() if not torch.isfinite(x).all() and name != "opacity_logits"]
    bad += ["opacity_logits"] if bool(gaussians.opacity_logits.isnan().any()) else []
    if bad:
        raise ValueError(f"{path} holds values that are not finite in {', '.join(bad)}: remove those Gaussians first.")
    scale, for_rendering = _opacity_scale(vertices.comments, path), _FOR_RENDERING in vertices.comments
    return PlyModel(gaussians, scale, for_rendering, *_trained_with(vertices.comments, path))


def _logits(opacities: Tensor, count: int) -> Tensor:
    """Return the logits of ``count`` opacities in [0, 1], in float64; infinite at the ends."""
    if opacities.shape != (count,) or not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise ValueError(
            f"opacities must have shape ({count},) and values in [0, 1], activated; got shape {tuple(opacities.shape)}"
            + (f" and values from {opacities.min():g} to {opacities.max():g}." if opacities.numel() else ".")
        )
    return torch.logit(opacities.double())


def _scaled_logits(logits: Tensor, factor: Tensor) -> Tensor:
    """Return ``logit(factor * sigmoid(logits))`` in float64, without the cancellation of ``1 - x``."""
    logits = logits.double()
    opaque, clear = logsigmoid(logits), logsigmoid(-logits)
    denominator = torch.logaddexp(opaque + torch.log1p(-factor), clear)  # 1 - f s = (1 - f) s + (1 - s)
    return opaque + factor.log() - denominator


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
    """Return the recorded regularizers and step, empty and 0 if there are none."""
    for comment in comments:
        if comment.startswith(_TRAINED_WITH):
            step, _, regularizer = comment.removeprefix(_TRAINED_WITH).strip().partition(" ")
            if not (step.isdecimal() and len(step) < 10):
                raise ValueError(f"{path}: expected a step after '{_TRAINED_WITH}', got '{comment:.80}'.")
            return regularizer, int(step)
    return "", 0
