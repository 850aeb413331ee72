"""The first minutes on a card: agreement, times, memory, launches, trainings, tests, as tables to paste into an issue.

    python -m benchmarks.gpu          # everything that this machine can do; what fails is named, and the rest goes on
    python -m benchmarks.gpu ahead    # without a card: all kernels compiled for all targets (or for those named)
    python -m benchmarks.gpu count    # without a card: operations and read-backs of scores and training steps
    python -m benchmarks.gpu lists    # without a card: operations and bytes of the exact moments of per-pixel lists

``count`` runs the kernels in Triton's interpreter where there is no card.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.counts import Model, counts_table, lists_table
from benchmarks.paper.scenes import SCENES
from ca_reg import CAScore
from ca_reg.functional import Multiplier
from ca_reg.neighbors import nearest_neighbors
from reference_trainer.evaluation.metrics import view_psnr
from reference_trainer.model.gaussians import SH_C0
from reference_trainer.render import (
    describe_engine,
    rasterize,
    render_masks,
    render_moments,
    splat,
    use_engine,
    variance_shares,
)
from reference_trainer.runs.run import model_of
from reference_trainer.scenes.load import load_scene
from reference_trainer.scenes.synthetic import synthetic_scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.recipes import with_recipe
from reference_trainer.training.trainer import Trainer

__all__ = ["main"]
ROOT = Path(__file__).resolve().parents[1]
_HALF = Multiplier.dropout(0.5)
_COMPARED = (3_000, 128, 0.03)  # Gaussians, pixels along a side, size: float64 takes a processor seconds
_HEAD = (
    "| workload | work | engine | ms, median of 20 | the card works, ms | peak MiB | launches | waits |",
    "|:--|:--|:--|---:|---:|---:|---:|---:|",
)
_STEPS, _CALLS = 1_000, 200
_TRAININGS: dict[str, tuple[str, dict[str, Any]]] = {
    "dropout": ("3dgs", {"dropout": 0.2}),
    "the expectation": ("3dgs", {"dropout": 0.2, "analytic": True}),
    "the recipe sparse": ("sparse", {}),
    "Binocular3DGS, dropout": ("binocular", {"dropout": 0.2}),
}
_SIZES = {"small": (20_000, 400, 0.02), "middle": (100_000, 800, 0.012), "large": (500_000, 800, 0.006)}


def _ahead(targets: list[str]) -> str:
    """Return the table of what the kernels need; raise if one spills or fails where others do not."""
    from benchmarks.ahead import KERNELS, TARGETS, compile_ahead, markdown

    rows, unknown, failed = [], [], []
    for target in targets or TARGETS:
        found, errors = [], []
        for kernel in KERNELS:
            try:
                found.append(compile_ahead(kernel, target))
            except Exception as error:
                errors.append(f"{kernel.label} on {target}: {_first_line(error)}")
        rows += found
        if found:
            failed += errors
        else:  # this Triton does not know the target
            unknown.append(errors[0])
    failed += [f"{x.kernel} on {x.target}: {x.spills} spills" for x in rows if x.spills]
    text = "\n".join([markdown(rows), "", *(f"not compiled, as no kernel of this target: {x}" for x in unknown)])
    if failed or not rows:
        raise RuntimeError("\n".join([text, *failed]))
    return text


def _first_line(error: Exception) -> str:
    """Return what failed in a line."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200].replace("|", "/")


def _tests() -> str:
    """Run the tests that need a card; raise with their last lines if one fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stdout[-3000:])
    return done.stdout.strip().splitlines()[-1]


def _times(on: str = "cuda") -> Iterator[str]:
    """Yield what renders, gradients, masks, scores, neighbors and steps take of time and memory; launches and waits."""
    yield from _HEAD
    for name, size in _SIZES.items():
        model = Model.of(*size, on)
        yield from _times_of(name, model, ("triton", "torch") if name == "small" else ("triton",))
        yield f"| {name} | 10 neighbors of all | - | {_measure(partial(nearest_neighbors, model.tensors[0], 10))} |"
    use_engine("triton")
    trainer = Trainer(synthetic_scene(), TrainConfig(dropout=0.2), on)
    yield f"| built-in scene | training step, dropout | triton | {_measure(trainer.train_step)} |"


def _times_of(name: str, model: Model, engines: Sequence[str]) -> Iterator[str]:
    """Yield a row for each work on a model by each engine, and by gsplat where it is installed."""
    means, quaternions, scales, opacities, colors = model.tensors
    keep = (torch.rand(5, len(means), device=means.device) > 0.5).float()
    score = CAScore.exact(model.moments, drop_rate=0.5)

    def forward() -> Any:
        return rasterize(splat(*model.tensors[:4], model.camera, colors=colors)).image

    def backward() -> Any:
        leaves = [x.clone().requires_grad_() for x in model.tensors]
        rasterize(splat(*leaves[:4], model.camera, colors=leaves[4])).image.square().sum().backward()

    def drawn(opacity: Tensor, camera: Any) -> tuple[Tensor, Tensor]:
        out = rasterize(splat(means, quaternions, scales, opacity, camera, colors=colors))
        return out.image, out.alpha

    def masks() -> Any:
        return render_masks(splat(*model.tensors[:4], model.camera, colors=colors), opacities * keep)

    works = {
        "render": torch.no_grad()(forward),
        "render and gradients": backward,
        "five masks": torch.no_grad()(masks),
        "score of five renders": partial(CAScore(drawn), opacities, model.camera),
        "exact score": partial(score, opacities, model.camera),
    }
    for engine in engines:
        use_engine(engine)
        for label, work in works.items():
            yield f"| {name} | {label} | {engine} | {_measure(work)} |"
    try:
        yield from _gsplat_times(name, model)
    except Exception as error:
        yield f"| {name} | all | gsplat | FAILED: {_first_line(error)} | | | | |"


def _trainings(on: str = "cuda") -> Iterator[str]:
    """Yield what trainings take and reach, and what work on the model of a scene's first takes.

    Of the built-in scene, and with three times the steps of fern, if $CA_REG_DATA holds it.
    """
    use_engine("triton")
    scenes, trained = {"built-in scene": synthetic_scene()}, dict[str, Trainer]()
    data = Path(os.environ.get("CA_REG_DATA", "data"))
    if (data / "fern").is_dir():
        scenes["fern"] = load_scene(SCENES["fern"].below(data).options)
    yield "| training | steps | with compiling, s | a step of the second half, ms | Gaussians | test PSNR, dB |"
    yield "|:--|---:|---:|---:|---:|---:|"
    for label, (recipe, settings) in _TRAININGS.items():
        for name, scene in scenes.items():
            steps = _STEPS * (3 if name == "fern" else 1)
            try:
                trainer = Trainer(scene, with_recipe(recipe, iterations=steps, **settings), on)
                trainer.train(until=steps // 2)
                half = trainer.seconds
                trainer.train()
                model, views = model_of(trainer), [view.to(on) for view in scene.test]
                with torch.no_grad():
                    psnr = statistics.fmean(view_psnr(model.test_rendering(view).image, view) for view in views)
            except Exception as error:  # name it, and go on with the next
                yield f"| {name}, {label} | FAILED: {_first_line(error)} | | | | |"
                continue
            trained.setdefault(name, trainer)
            step = (trainer.seconds - half) / (steps - steps // 2)
            cells = steps, f"{trainer.seconds:.1f}", f"{1e3 * step:.1f}", len(trainer.gaussians), f"{psnr:.1f}"
            yield f"| {name}, {label} | {' | '.join(map(str, cells))} |"
    yield from ("", *_HEAD) if trained else ()
    for name, trainer in trained.items():
        camera = scenes[name].test[0].camera.to(on, torch.float32)
        x = trainer.gaussians.map(Tensor.detach).params(camera)
        colors = 0.5 + SH_C0 * x.sh[:, 0]
        model = Model([x.means, x.quaternions, x.scales, x.opacities, colors], camera)
        yield from _times_of(f"{name}, trained", model, ("triton",))


def _launches(on: str = "cuda") -> Iterator[str]:
    """Yield what the start of each kernel of a picture and its gradients takes the host, by Triton and directly."""
    from reference_trainer.render.triton import binning, compositing, launching, projection, tiles

    use_engine("triton")
    model, calls = Model.of(*_SIZES["small"], on), list[tuple[tuple[Any, ...], dict[str, Any]]]()

    def noted(*arguments: Any, **constants: Any) -> None:
        calls.append((arguments, constants))
        launching.launch(*arguments, **constants)

    with ExitStack() as stack:
        for module in (projection, binning, tiles, compositing):
            stack.enter_context(patch.object(module, "launch", noted))
        leaves = [x.clone().requires_grad_() for x in model.tensors]
        rasterize(splat(*leaves[:4], model.camera, colors=leaves[4])).image.sum().backward()
    yield "| kernel | arguments | started by Triton, us of the host | directly, us |"
    yield "|:--|---:|---:|---:|"
    for (function, grid, *arguments), constants in calls:
        options = {name: x for name, x in constants.items() if name != "warps"} | {"enable_fp_fusion": True}
        ways = (
            partial(function[grid], *arguments, num_warps=constants.get("warps", 1), **options),
            partial(launching.launch, function, grid, *arguments, **constants),
        )
        cells = [f"{1e6 * _host_seconds(way, on):.1f}" for way in ways]
        yield f"| {function.fn.__name__} | {len(function.arg_names)} | {' | '.join(cells)} |"


def _host_seconds(work: Callable[[], Any], on: str) -> float:
    """Return what one of many calls takes the host, which does not wait for them."""
    work()
    if on != "cpu":
        torch.cuda.synchronize()
    begun = time.perf_counter()
    for _ in range(_CALLS):
        work()
    return (time.perf_counter() - begun) / _CALLS


def _measure(work: Callable[[], Any]) -> str:
    """Return the cells of a call, from its time on; or what it failed with."""
    try:
        return " | ".join(_measured(work))
    except Exception as error:  # name it, and measure the next
        return f"FAILED: {_first_line(error)} | | | |"


def _measured(work: Callable[[], Any]) -> list[str]:
    """Return the median time of a call, what of it the card works, the peak of memory, launches and waits."""
    for _ in range(3):
        work()
    times = []
    for _ in range(20):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        torch.cuda.synchronize()
        times.append(begin.elapsed_time(end))
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    work()
    peak = (torch.cuda.max_memory_allocated() - before) / 2**20
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        work()
        torch.cuda.synchronize()
    on_card = [x for x in profile.events() if x.device_type == torch.autograd.DeviceType.CUDA]
    kernels = sum(not x.name.startswith(("Memcpy", "Memset")) for x in on_card)
    busy = sum(x.device_time for x in on_card) / 1e3
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            work()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = sum("synchronizing" in str(x.message) for x in caught)
    return [f"{statistics.median(times):.2f}", f"{busy:.2f}", f"{peak:.0f}", str(kernels), str(waits)]


def _gsplat_times(name: str, model: Model) -> Iterator[str]:
    """Yield rows of gsplat's own render, and of the exact score over its lists; none where it is missing."""
    if find_spec("gsplat") is None:
        return
    import gsplat

    from reference_trainer.render.triton.gsplat import GsplatMoments

    means, quats, scales, opacities, colors = model.tensors
    render = partial(_rasterize, gsplat, model)
    moments = GsplatMoments(lambda opacity, _: (colors, render(means, quats, scales, opacity, colors)[2]))

    def backward() -> None:
        leaves = [x.clone().requires_grad_() for x in model.tensors]
        render(*leaves)[0].square().sum().backward()

    works = {
        "render": torch.no_grad()(lambda: render(means, quats, scales, opacities, colors)),
        "render and gradients": backward,
        "exact score over its lists": lambda: CAScore.exact(moments, drop_rate=0.5)(opacities, None),
    }
    label = f"gsplat {gsplat.__version__}"
    for what, work in works.items():
        yield f"| {name} | {what} | {label} | {_measure(work)} |"


def _rasterize(gsplat: Any, model: Model, *tensors: Tensor) -> Any:
    """Render with gsplat, not packed."""
    c = model.camera
    intrinsics = torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]], device=tensors[0].device)
    pose = c.world_to_camera[None]
    return gsplat.rasterization(*tensors, pose, intrinsics[None], c.width, c.height, near_plane=0.2, packed=False)


def _outcome(engine: str, device: str, dtype: torch.dtype = torch.float32) -> dict[str, list[Tensor]]:
    """Return what an engine makes of a model: pictures, moments, shares and gradients, on the processor."""
    use_engine(engine)
    model = Model.of(*_COMPARED, device)
    leaves = [x.to(dtype).requires_grad_() for x in model.tensors]
    splats = splat(*leaves[:4], model.camera.to(dtype=dtype), colors=leaves[4])
    image, (mean, variance, _) = rasterize(splats).image, render_moments(splats, _HALF)
    found = {
        "picture": [image],
        "mean": [mean],
        "variance": [variance],
        "shares": [variance_shares(splats, _HALF, torch.ones_like(image[0]))],
        "gradients of a picture": torch.autograd.grad(image.square().sum(), leaves, retain_graph=True),
        "gradients of moments": torch.autograd.grad((mean.square() + variance).sum(), leaves),
    }
    return {name: [x.detach().cpu() for x in tensors] for name, tensors in found.items()}


def _gsplat_outcome(device: str) -> dict[str, list[Tensor]]:
    """Return gsplat's picture, and moments and shares over its lists."""
    import gsplat

    from reference_trainer.render.triton.gsplat import GsplatMoments

    model = Model.of(*_COMPARED, device)
    with torch.no_grad():
        shown, _, meta = _rasterize(gsplat, model, *model.tensors)
    moments = GsplatMoments(lambda opacity, view: (model.tensors[4], meta))
    given = model.tensors[3], None, _HALF, None
    mean, variance, _ = moments(*given)
    found = {"picture": shown[0].permute(2, 0, 1), "mean": mean, "variance": variance}
    found["shares"] = moments.shares(*given, weights=torch.ones_like(mean[0]))
    return {name: [x.cpu()] for name, x in found.items()}


def _agreement(device: str = "cuda") -> Iterator[str]:
    """Yield how far gsplat and the engines are from the engine torch in float64 on the processor."""
    exact = _outcome("torch", "cpu", torch.float64)
    makers = {"triton": partial(_outcome, "triton", device), "torch": partial(_outcome, "torch", device)}
    if find_spec("gsplat") is not None:
        makers["gsplat"] = partial(_gsplat_outcome, device)
    yield f"| largest error over the largest value | {' | '.join(exact)} |"
    yield f"|:--|{'---:|' * len(exact)}"
    for name, make in makers.items():
        try:
            found = make()
        except Exception as error:  # name it, and go on with the next
            yield f"| {name} | FAILED: {_first_line(error)} |{' |' * (len(exact) - 1)}"
            continue
        yield f"| {name} | {' | '.join(_apart(found[x], exact[x]) if x in found else '' for x in exact)} |"
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        one, other = (_outcome("triton", device) for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(before)
    changed = [name for name in one if not all(map(torch.equal, one[name], other[name]))]
    yield ""
    yield f"FAILED: deterministic runs differ in {', '.join(changed)}" if changed else "Deterministic runs agree."


def _apart(found: Sequence[Tensor], exact: Sequence[Tensor]) -> str:
    """Return the largest error of some tensors, each relative to its largest number."""
    return f"{max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(found, exact, strict=True)):.1e}"


def main(arguments: list[str]) -> int:
    """Print one section, or all that this machine can do; return how many of those, and of their lines, failed."""
    alone: dict[str, Callable[[], str | Iterator[str]]] = {
        "ahead": partial(_ahead, arguments[1:]),
        "count": counts_table,
        "lists": lists_table,
    }
    if arguments and arguments[0] not in alone:
        print(f"there is no {arguments[0]!r}: give ahead, count, lists, or nothing.", file=sys.stderr)
        return 2
    if arguments:
        sections = {arguments[0]: alone[arguments[0]]}
    elif torch.cuda.is_available():
        sections = {
            "agreement": _agreement,
            "times": _times,
            "launches": _launches,
            "trainings": _trainings,
            "count": counts_table,
            "tests on the card": _tests,
        }
        print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {describe_engine('cuda')}\n")
    else:
        sections = alone
        print("No card, so no agreement, times and tests on one: what follows was compiled or interpreted.\n")
    failed = 0
    for name, section in sections.items():
        begun = time.perf_counter()
        if not arguments:
            print(f"### {name}\n")
        try:
            text = section()
            for line in [text] if isinstance(text, str) else text:
                failed += "FAILED: " in line
                print(line, flush=True)
        except Exception as error:  # a card can refuse anything: name it, and go on
            failed += 1
            print(f"FAILED: {''.join(traceback.format_exception_only(error)).strip()}")
        print(f"\n{time.perf_counter() - begun:.0f} s\n" if not arguments else "", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
