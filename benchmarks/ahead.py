"""Compile the Triton kernels ahead of time to machine code of NVIDIA and AMD cards, without a card, and read it.

``python -m benchmarks.gpu ahead`` prints the table: registers, shared memory, spills, and the instructions of a warp
per list entry, which are those of the innermost loops.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import triton
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from reference_trainer.model import _adam_triton
from reference_trainer.render.triton import binning, compositing, moments, projection, tiles
from reference_trainer.training.density import _statistics_triton
from reference_trainer.training.losses import _ssim_triton

__all__ = ["KERNELS", "TARGETS", "Compiled", "Kernel", "compile_ahead", "markdown", "measure_nvidia"]

TARGETS = {f"sm_{x}": GPUTarget("cuda", x, 32) for x in (75, 80, 86, 89, 90, 100, 120)}
TARGETS |= {f"gfx{x}": GPUTarget("hip", f"gfx{x}", 64 if x[0] == "9" else 32) for x in ("90a", "942", "1100", "1201")}

# Types by the names of the arguments, which are the same in all kernels; the others are float32 numbers in memory.
_TYPES = {name: "*i32" for name in ("starts", "gaussians", "counts", "visible", "places")}
_TYPES |= {"indices": "*i64", "order": "*i64", "ends": "*i64", "keys": "*i16", "numbers": "*fp64"}
_TYPES |= {"touched": "*u8"}
_TYPES |= {name: "i32" for name in ("first", "count", "width", "height", "columns", "listing", "tiles")}
_TYPES |= {name: "i32" for name in ("stride", "absolute_stride", *(f"count{i}" for i in range(6)))}
_TYPES |= {f"row_{name}": "i32" for name in ("centers", "factors", "depths", "colors", "opacities")}
_TYPES |= {name: "fp32" for name in ("fx", "fy", "cx", "cy", "limit_x", "limit_y", "half_width", "half_height")}
_TYPES |= {name: "fp32" for name in ("of_error", "of_ssim", "gain1", "gain2", "correction", "epsilon")}
_TYPES |= {f"rate{i}": "fp32" for i in range(6)}


@dataclass(frozen=True)
class Kernel:
    """A kernel with the constants and warps of one of its uses; ``walks`` whether it walks over lists.

    ``types`` are those of arguments that differ from use to use.
    """

    label: str
    function: Any
    constants: dict[str, Any]
    warps: int = 1
    walks: bool = True
    types: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Compiled:
    """What the machine code of a kernel needs; ``per_entry`` instructions, or None if it does not walk over lists."""

    kernel: str
    target: str
    registers: int
    shared: int
    spills: int
    instructions: int
    per_entry: int | None


def _tiled(label: str, function: Any, columns: int, tile: int = 8, warps: int = 1, **constants: Any) -> Kernel:
    return Kernel(label, function, {"STRIDE": columns, "TILE": tile, **constants}, warps)


def _projection(bands: int) -> list[Kernel]:
    constants = {"BANDS": bands, "ROW": max(1, bands), "BLOCK": 128}
    colors = f"degree {round(bands**0.5) - 1}" if bands else "colors"
    forward, backward = projection.project_forward, projection.project_backward
    return [
        Kernel(f"project, {colors}", forward, constants, 4, walks=False),
        Kernel(f"project backward, {colors}", backward, constants | {"DEPTHS": False}, 4, walks=False),
        Kernel(f"project backward, depth, {colors}", backward, constants | {"DEPTHS": True}, 4, walks=False),
    ]


def _photometric(label: str, expected: bool) -> list[Kernel]:
    block = {"WIDE": 32, "HIGH": 16}
    constants = block | {"EXPECTED": expected}
    return [
        Kernel(f"{label}, rows", _ssim_triton.blur_images, constants, 8, walks=False),
        Kernel(f"{label}, columns", _ssim_triton.compare_images, constants, 8, walks=False),
        Kernel(f"{label} backward, rows", _ssim_triton.blur_slopes, block, 8, walks=False),
        Kernel(f"{label} backward, columns", _ssim_triton.gather_gradients, constants, 8, walks=False),
    ]


def _carried(label: str, depth: bool, absolute: bool) -> list[Kernel]:
    """Return the backward pass of a picture, adding in any order and in one."""
    constants = {"DEPTH": depth, "ABSOLUTE": absolute}
    return [
        _tiled(f"{label}{order}", compositing.composite_backward, 9 + depth, **constants, EACH=bool(order))
        for order in ("", ", in order")
    ]


_LISTING = {"TILE": 8, "GROUP": 32, "LANES": 8}
KERNELS = [
    Kernel("find visible", projection.find_visible, {"BLOCK": 1024}, 4, walks=False),
    Kernel("index visible", projection.index_visible, {"BLOCK": 1024}, 4, walks=False),
    *(kernel for bands in (0, 1, 4, 9, 16) for kernel in _projection(bands)),
    *(Kernel(f"fill table, {x} more", tiles.fill_table, {"MORE": x, "BLOCK": 256}, 4, walks=False) for x in (0, 1, 2)),
    Kernel("list tiles", binning.list_tiles, _LISTING, walks=False),
    Kernel("list tiles, 2^15 and more", binning.list_tiles, _LISTING, walks=False, types={"keys": "*i32"}),
    Kernel("gather lists", binning.gather_lists, {"BLOCK": 1024}, 4, walks=False, types={"found": "*i32"}),
    *(
        Kernel("densification", _statistics_triton.add_gradients, {"ABSOLUTE": x, "BLOCK": 256}, 4, walks=False)
        for x in (False, True)
    ),
    Kernel("Adam", _adam_triton.adam, {"BLOCK": 1024}, 4, walks=False),
    _tiled("composite", compositing.composite_forward, 9, DEPTH=False),
    _tiled("composite, depth", compositing.composite_forward, 10, DEPTH=True),
    *_carried("composite backward", depth=False, absolute=False),
    *_carried("composite backward, depth", depth=True, absolute=False),
    *_carried("absolute gradients", depth=True, absolute=True),
    *(_tiled(f"masks, {k} at once", compositing.composite_masked, 9, MASKS=k) for k in (1, 2, 4)),
    _tiled("moments", moments.moments_forward, 11, MAX=0.99),
    _tiled("moments backward, shares", moments.moments_backward, 11, MAX=0.99, EACH=False),
    _tiled("moments backward, in order", moments.moments_backward, 11, MAX=0.99, EACH=True),
    _tiled("moments, gsplat's tiles", moments.moments_forward, 11, 16, 4, MAX=0.999),
    _tiled("shares, gsplat's tiles", moments.moments_backward, 11, 16, 4, MAX=0.999, EACH=False),
    _tiled("shares, gsplat's tiles, in order", moments.moments_backward, 11, 16, 8, MAX=0.999, EACH=True),
    *_photometric("loss", expected=False),
    *_photometric("expected loss", expected=True),
]


def compile_ahead(kernel: Kernel, target: str, **options: Any) -> Compiled:
    """Compile a kernel for a target of `TARGETS`.

    Raises:
        Exception: Triton's own, for example if it does not know the target.
    """
    names = kernel.function.arg_names
    types = _TYPES | dict.fromkeys(kernel.constants, "constexpr") | kernel.types
    signature = {name: types.get(name, "*fp32") for name in names}
    options = {"num_warps": kernel.warps, "enable_fp_fusion": True} | options
    if kernel.walks and TARGETS[target].backend == "cuda":
        options = tiles.nvidia_options(kernel.warps) | options
    source = ASTSource(fn=kernel.function, signature=signature, constexprs=kernel.constants)
    code = triton.compile(source, target=TARGETS[target], options=options).asm
    registers, shared, spills, rows = measure_nvidia(code["cubin"]) if "cubin" in code else _measure_amd(code["amdgcn"])
    return Compiled(
        kernel.label, target, registers, shared, spills, len(rows), _per_entry(rows) if kernel.walks else None
    )


class Step(NamedTuple):
    """An instruction: where it jumps to, if it does, whether the next one may follow, whether it is an exponential."""

    jump: int | None
    falls: bool
    exponential: bool


def measure_nvidia(cubin: bytes) -> tuple[int, int, int, list[Step]]:
    """Return registers, shared memory, spills, and the instructions.

    Spills are the instructions that touch local memory, where the assembler puts what does not fit into registers.
    """
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "kernel.cubin")
        file.write_bytes(cubin)
        usage, sass = (
            subprocess.run([tool, option, file], capture_output=True, text=True, check=True).stdout
            for option in ("-res-usage", "-sass")
        )
    found = {name: int(value) for name, value in re.findall(r"(REG|SHARED|STACK|LOCAL):(\d+)", usage)}
    lines = re.findall(r"/\*([0-9a-f]{4,})\*/\s+(.+?)\s*;", sass)
    lines = [(address, text) for address, text in lines if text != "NOP"]
    places = {int(address, 16): i for i, (address, _) in enumerate(lines)}
    steps = []
    for _, text in lines:
        jump = re.search(r"\bBRA(?!\.DIV).*?0x([0-9a-f]+)", text)  # lanes do not diverge
        ends = re.match(r"(BRA(\.U)? 0x|EXIT|RET)", text)
        steps.append(Step(places.get(int(jump[1], 16)) if jump else None, not ends, "MUFU.EX2" in text))
    spills = sum(bool(re.search(r"\b(LDL|STL)\b", text)) for _, text in lines)
    return found["REG"], found["SHARED"], spills + found["STACK"] + found["LOCAL"], steps


def _measure_amd(assembly: str) -> tuple[int, int, int, list[Step]]:
    """The same from the text of the assembler, which says at its end what is needed."""
    found = {name: int(value) for name, value in re.findall(r"\.(\w+):\s+(\d+)\s*$", assembly, re.M)}
    labels: dict[str, int] = {}
    lines = []
    for line in assembly.splitlines():
        if label := re.match(r"(\.L\w+):", line):
            labels[label[1]] = len(lines)
        elif re.match(r"\t([sv]|global|flat|buffer|ds|scratch)_", line):
            lines.append(line.strip())
    steps = []
    for line in lines:
        jump = re.match(r"s_c?branch\w*\s+(\.L\w+)", line)
        ends = re.match(r"s_(branch|endpgm)\b", line)
        steps.append(Step(labels.get(jump[1]) if jump else None, not ends, "v_exp_f32" in line))
    spills = found["vgpr_spill_count"] + found["sgpr_spill_count"] + found["private_segment_fixed_size"]
    return found["vgpr_count"], found["group_segment_fixed_size"], spills, steps


def _per_entry(steps: list[Step]) -> int:
    """Return the instructions of the innermost loops that evaluate alphas, i.e. those of one entry of a list.

    A loop is a strongly connected part of the program; without its first instruction, what is still connected is a
    loop within it.
    """
    edges = [(i, i + 1) for i, step in enumerate(steps[:-1]) if step.falls]
    edges += [(i, step.jump) for i, step in enumerate(steps) if step.jump is not None]

    def loops(within: set[int]) -> int:
        inside = [(a, b) for a, b in edges if a in within and b in within]
        rows, columns = zip(*inside, strict=True) if inside else ((), ())
        graph = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(steps), len(steps)))
        _, label = connected_components(graph, connection="strong")
        total = 0
        for part in np.flatnonzero(np.bincount(label) > 1):
            members = set(np.flatnonzero(label == part).tolist())
            if any(steps[i].exponential for i in members):
                head = min(b for a, b in edges if b in members and a not in members)
                total += loops(members - {head}) or len(members)
        return total

    return loops(set(range(len(steps))))


def markdown(rows: list[Compiled]) -> str:
    """Return the table, a row for every kernel: what holds for all targets, from the least to the most."""

    def span(values: list[int | None]) -> str:
        known = sorted({x for x in values if x is not None})
        return "" if not known else f"{known[0]}" if len(known) == 1 else f"{known[0]} to {known[-1]}"

    out = ["| kernel | maker | registers | shared memory, bytes | spills | instructions | per entry and warp |"]
    out.append("|:--|:--|---:|---:|---:|---:|---:|")
    for name in dict.fromkeys(row.kernel for row in rows):
        for maker, prefix in (("NVIDIA", "sm_"), ("AMD", "gfx")):
            if of := [row for row in rows if row.kernel == name and row.target.startswith(prefix)]:
                fields = ("registers", "shared", "spills", "instructions", "per_entry")
                cells = (span([getattr(row, field) for row in of]) for field in fields)
                out.append(f"| {name} | {maker} | {' | '.join(cells)} |")
    return "\n".join(out)
