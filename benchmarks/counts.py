"""What would be launched, waited for and kept on a card, counted by PyTorch's dispatcher, without one.

The kernels run in Triton's interpreter where there is no card. ``python -m benchmarks.gpu count`` and ``lists`` print
the tables.
"""

from __future__ import annotations

import os
import subprocess
import sys
import weakref
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from ca_reg import CAScore
from ca_reg.functional import Multiplier
from ca_reg.lists import ListMoments, PixelLists
from reference_trainer.camera import Camera
from reference_trainer.render import render_moments, splat, use_engine
from reference_trainer.render.engine import engine_for
from reference_trainer.render.splats import Splats
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

__all__ = [
    "Counts",
    "ListCounts",
    "Model",
    "StepCounts",
    "bytes_per_entry",
    "count_exact_score",
    "count_lists",
    "count_step",
    "counted",
    "counts_table",
    "lists_table",
]

ROOT = Path(__file__).resolve().parents[1]
_STEPS: dict[str, dict[str, Any]] = {
    "plain": {},
    "dropout": {"dropout": 0.2},
    "expectation": {"dropout": 0.2, "analytic": True},
}


class Model(NamedTuple):
    """Random Gaussians in a cube before a square picture: what is measured, the same on every machine."""

    tensors: list[Tensor]  # means, quaternions, scales, opacities, colors
    camera: Camera

    @classmethod
    def of(cls, count: int, width: int, scale: float, device: torch.device | str) -> Model:
        """Draw a number of Gaussians of a size."""
        g = torch.Generator().manual_seed(0)
        means, quaternions = torch.rand(count, 3, generator=g) - 0.5, torch.randn(count, 4, generator=g)
        scales = scale * torch.exp(torch.rand(count, 3, generator=g) - 0.5)
        opacities, colors = 0.1 + 0.8 * torch.rand(count, generator=g), torch.rand(count, 3, generator=g)
        pose = torch.eye(4)
        pose[2, 3] = 1.5
        camera = Camera(pose, 1.2 * width, 1.2 * width, width / 2, width / 2, width, width).to(device, torch.float32)
        return cls([x.to(device) for x in (means, quaternions, scales, opacities, colors)], camera)

    def moments(self, opacity: Tensor, view: Camera, multiplier: Multiplier, background: Tensor | None) -> Any:
        """Render exact moments: what `CAScore` takes."""
        means, quaternions, scales, _, colors = self.tensors
        return render_moments(
            splat(means, quaternions, scales, opacity, view, colors=colors), multiplier, background=background
        )


class Counts(NamedTuple):
    """What an exact score costs, beyond its arithmetic.

    ``rendering`` of the operations (kernels of Triton included) are those of the engine, without the checks of its
    inputs and without what the score does with the moments.
    """

    operations: int
    rendering: int
    read_backs: int
    entries: int


class _Operations(TorchDispatchMode):
    """Counts operations that would launch something on a card, waits for a card, and the bytes of what lives."""

    _FREE = (
        "empty",
        "empty_like",
        "detach",
        "alias",
        "lift_fresh",
        "_unsafe_view",
        "_local_scalar_dense",
        "set_",
        "new_empty",
    )

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        self.alive: dict[int, tuple[int, int]] = {}  # bytes and tensors of a storage, by its address
        self.now = self.peak = self.elements = self.read_backs = 0
        self.copied: set[int] = set()  # addresses of what the processor has read, while all is on the processor
        self.paused = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if self.paused:
            return out
        schema = func._schema
        leaves = schema.name == "aten::_to_copy" and out.is_cpu and not args[0].is_cpu
        if leaves or schema.name in ("aten::_local_scalar_dense", "aten::nonzero"):
            self.note_read(args[0])
        view = any(x.alias_info is not None and not x.alias_info.is_write for x in schema.arguments)
        if not view:
            self.names[schema.name.removeprefix("aten::")] += 1
        for x in pytree.tree_leaves(out):
            if isinstance(x, Tensor):
                self.elements += 0 if view else x.numel()
                self._hold(x)
        return out

    def note_read(self, x: Tensor) -> None:
        """Count a read-back, unless the numbers are the processor's already."""
        on_card = torch.cuda.is_available()
        self.read_backs += not (x.is_cpu if on_card else x.untyped_storage().data_ptr() in self.copied)

    def _hold(self, x: Tensor) -> None:
        storage = x.untyped_storage()
        key = storage.data_ptr()
        size, holders = self.alive.get(key, (storage.nbytes(), 0))
        self.alive[key] = size, holders + 1
        self.now += size if holders == 0 else 0
        self.peak = max(self.peak, self.now)
        weakref.finalize(x, self._release, key)

    def _release(self, key: int) -> None:
        size, holders = self.alive.pop(key)
        if holders > 1:
            self.alive[key] = size, holders - 1
        else:
            self.now -= size
            self.copied.discard(key)

    @property
    def launches(self) -> int:
        return sum(n for name, n in self.names.items() if name not in self._FREE)


class _ReadBacks(TorchFunctionMode):
    """Notes `tolist` and `cpu`, which PyTorch's dispatcher does not see on a processor."""

    def __init__(self, operations: _Operations) -> None:
        super().__init__()
        self.operations = operations

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (Tensor.tolist, Tensor.cpu) and args[0].is_cpu and not self.operations.paused:
            self.operations.note_read(args[0])
            if func is Tensor.cpu:
                self.operations.copied.add(args[0].untyped_storage().data_ptr())
        return func(*args, **(kwargs or {}))


@contextmanager
def _outside_of_kernels(mode: _Operations) -> Any:
    """Do not count what Triton's interpreter itself does, where it runs."""
    import triton.runtime.interpreter as interpreter

    run = interpreter.GridExecutor.__call__

    def paused(*args: Any, **kwargs: Any) -> Any:
        mode.paused = True
        try:
            return run(*args, **kwargs)
        finally:
            mode.paused = False

    interpreter.GridExecutor.__call__ = paused
    try:
        yield
    finally:
        interpreter.GridExecutor.__call__ = run


def counted(work: Callable[[], Any]) -> tuple[int, _Operations, Any]:
    """Return the launches of a call, what was counted, and what it returned."""
    from reference_trainer.render.triton.launching import LAUNCHED

    mode, before = _Operations(), sum(LAUNCHED.values())
    with _outside_of_kernels(mode), _ReadBacks(mode), mode:
        out = work()
    return mode.launches + sum(LAUNCHED.values()) - before, mode, out


@torch.no_grad()
def count_exact_score(count: int, width: int, scale: float, device: torch.device | str = "cpu") -> Counts:
    """Count what the exact score of a view costs with the engine triton, by PyTorch's dispatcher."""
    use_engine("triton")
    model = Model.of(count, width, scale, device)
    means, quaternions, scales, opacities, colors = model.tensors
    score = partial(CAScore.exact(model.moments, drop_rate=0.5), opacities, model.camera)
    score()  # loads what is loaded once
    splats = splat(means, quaternions, scales, opacities, model.camera, colors=colors)
    inputs = {"means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "colors": colors}
    multiplier, background = torch.full((count, 2), 0.25, device=device), torch.zeros(3, width, width, device=device)

    def rendering() -> Any:
        projected = splats.engine.project(inputs, model.camera, None)
        lists = splats.engine.bin(projected, width, width)
        return splats.engine.moments(Splats(*projected[:4], lists, splats.engine), multiplier, background)

    operations, mode, _ = counted(score)
    return Counts(operations, counted(rendering)[0], mode.read_backs, len(splats.lists.gaussians))


class StepCounts(NamedTuple):
    """What a training step costs: its operations without the optimizer's, those of the loss, the optimizer's; waits."""

    operations: int
    loss: int
    optimizer: int
    read_backs: int


def count_step(device: torch.device | str = "cpu", **settings: Any) -> StepCounts:
    """Count a training step of the built-in scene in little, with the engine triton, by PyTorch's dispatcher."""
    from reference_trainer.render.triton.launching import LAUNCHED

    use_engine("triton")
    scene = synthetic_scene(width=32, height=24, points=40)
    trainer = Trainer(scene, with_recipe("3dgs", iterations=3_000, **settings), device)
    trainer.train_step()  # loads what is loaded once
    photograph = scene.train[0].image.to(device)
    image = (photograph / 2).requires_grad_()
    loss, _, _ = counted(lambda: photometric_loss(image, photograph).backward())
    begun = LAUNCHED["adam"]
    everything, mode, _ = counted(trainer.train_step)
    optimizer = LAUNCHED["adam"] - begun
    return StepCounts(everything - optimizer, loss, optimizer, mode.read_backs)


@torch.no_grad()
def bytes_per_entry(device: torch.device | str = "cpu") -> float:
    """Return the bytes that every further list entry takes at the peak, which is while lists are made.

    Of the tensors that PyTorch hands out: what `torch.sort` takes for itself on a card is not seen here.
    """
    use_engine("triton")
    peaks, entries = [], []
    for scale in (0.1, 2.0):
        model = Model.of(60, 64, scale, device)
        inputs = dict(zip(("means", "quaternions", "scales", "opacities", "colors"), model.tensors, strict=True))
        engine = engine_for(torch.device(device))
        projected = engine.project(inputs, model.camera, None)
        _, mode, lists = counted(partial(engine.bin, projected, 64, 64))
        peaks.append(mode.peak)
        entries.append(len(lists.gaussians))
    return (peaks[1] - peaks[0]) / (entries[1] - entries[0])


class ListCounts(NamedTuple):
    """What the exact moments of per-pixel lists cost: operations, elements that these write, and bytes at the peak."""

    entries: int
    longest: int
    operations: int
    elements: int
    peak: int

    def __sub__(self, other: ListCounts) -> ListCounts:
        return ListCounts(*(a - b for a, b in zip(self, other, strict=True)))


def count_lists(length: int, width: int = 64, *, gradient: bool = False) -> ListCounts:
    """Count what the exact moments of a picture cost whose pixels have lists of up to twice a length."""
    g = torch.Generator().manual_seed(0)
    count = width**2
    lengths = torch.randint(0, 2 * length, (count,), generator=g)
    pixels = torch.arange(count, dtype=torch.int32).repeat_interleave(lengths)
    gaussians = torch.randint(0, count, pixels.shape, generator=g, dtype=torch.int32)
    alphas = torch.rand(len(pixels), generator=g).requires_grad_(gradient)
    lists = PixelLists(gaussians, pixels, alphas, torch.rand(count, 3, generator=g), width, width)
    with _Operations() as mode, torch.set_grad_enabled(gradient):
        out = ListMoments(lambda opacity, view: lists)(torch.ones(count), None, Multiplier.dropout(0.5), None)
        if gradient:
            out.variance.sum().backward()
    return ListCounts(len(pixels), int(lengths.max()), mode.launches, mode.elements, mode.peak)


def lists_table() -> str:
    """Return the table of what longer lists cost."""
    out = ["| exact moments of lists | entries | longest | operations | elements per entry | bytes per further entry |"]
    out += ["|:--|---:|---:|---:|---:|---:|"]
    for label, gradient in (("without gradients", False), ("with gradients", True)):
        rows = [count_lists(length, gradient=gradient) for length in (512, 1024, 2048)]
        for row, before in zip(rows[1:], rows[:-1], strict=True):
            further = row - before
            out.append(
                f"| {label} | {row.entries} | {row.longest} | {row.operations} | {row.elements / row.entries:.1f} | "
                f"{further.peak / further.entries:.1f} |"
            )
    return "\n".join(out)


def counts_table() -> str:
    """Return the table of counts, in the interpreter where there is no card."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu" and os.environ.get("TRITON_INTERPRET") != "1":
        command, environment = [sys.executable, "-m", "benchmarks.gpu", "count"], os.environ | {"TRITON_INTERPRET": "1"}
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    rows = [count_exact_score(*size, device) for size in ((24, 24, 0.05), (24, 24, 0.2), (48, 40, 0.1))]
    out = ["| entries | operations of an exact score | of them the engine's | read-backs |", "|---:|---:|---:|---:|"]
    out += [f"| {x.entries} | {x.operations} | {x.rendering} | {x.read_backs} |" for x in rows]
    out += ["", f"{bytes_per_entry(device):.1f} bytes per list entry at the peak.", ""]
    out += ["| a training step | operations without Adam's | of them the loss's | Adam's | read-backs |"]
    out += ["|:--|---:|---:|---:|---:|"]
    for name, settings in _STEPS.items():
        out.append(f"| {name} | {' | '.join(map(str, count_step(device, **settings)))} |")
    return "\n".join(out)
