"""Where a :class:`ca_reg.CAMonitor` writes besides its own log: TensorBoard, Weights & Biases, MLflow, or your own."""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

__all__ = ["MLflowSink", "Sink", "Sinks", "WandbSink", "check_sinks"]


class Sink:
    """The methods of a TensorBoard ``SummaryWriter`` that are called; anything that has them will do, too."""

    def add_scalar(self, name: str, value: float, step: int) -> None:
        """Add a point of a curve."""
        self._log(name, value, step)

    def add_image(self, name: str, image: Tensor, step: int) -> None:
        """Add a picture (3, H, W) in [0, 1]."""
        pixels = (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
        self._log(name, np.ascontiguousarray(pixels), step)

    def add_histogram(self, name: str, values: Tensor, step: int) -> None:
        """Add the distribution of numbers (N,)."""
        self._log(name, values.detach().cpu().numpy(), step)

    def add_text(self, name: str, text: str, step: int) -> None:
        """Add text, such as the settings."""
        self._log(name, text, step)

    def flush(self) -> None:
        """Write what is pending; called after every measurement."""

    def close(self) -> None:
        """End the log."""

    def _log(self, name: str, x: Any, step: int) -> None:
        """Log a number, a picture (H, W, 3) of bytes, numbers (N,), or text."""
        raise NotImplementedError


def check_sinks(sinks: Any) -> None:
    """Raise a TypeError unless these are several objects, none or more, with the methods of :class:`Sink`."""
    if not isinstance(sinks, list | tuple):
        raise TypeError(f"sinks must be a list, such as [WandbSink()], got {type(sinks).__name__}.")
    methods = [name for name in vars(Sink) if not name.startswith("_")]
    for sink in sinks:
        if isinstance(sink, type) or not all(callable(getattr(sink, name, None)) for name in methods):
            got = f"the class {sink.__name__}" if isinstance(sink, type) else type(sink).__name__
            raise TypeError(f"sinks must have the methods {', '.join(methods)}, such as WandbSink(), got {got}.")


class Sinks:
    """Several sinks as one: a call of a method of :class:`Sink` goes to all of them."""

    def __init__(self, sinks: Sequence[Any]) -> None:
        self._sinks = tuple(sinks)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or not hasattr(Sink, name):
            raise AttributeError(name)
        return lambda *arguments: [getattr(sink, name)(*arguments) for sink in self._sinks]


class WandbSink(Sink):
    """Write to a run of Weights & Biases; text becomes a part of its configuration.

    Args:
        run: what ``wandb.init`` returned, which stays open; by default a new run.
        init: arguments of ``wandb.init`` for a new run: ``project=``, ``name=``, ``mode="offline"``.
    """

    def __init__(self, run: Any = None, **init: Any) -> None:
        self._wandb, self._own = _library("wandb"), run is None
        self._run = self._wandb.init(**init) if run is None else run
        self._run.define_metric("*", step_metric="step")  # a resumed training repeats steps, which W&B's own may not

    def _log(self, name: str, x: Any, step: int) -> None:
        if isinstance(x, str):
            self._run.config.update({name: x}, allow_val_change=True)
        else:
            kind = {3: self._wandb.Image, 1: self._wandb.Histogram}.get(np.ndim(x), float)
            self._run.log({name: kind(x), "step": step})

    def close(self) -> None:
        """Finish a run that was made here."""
        if self._own:
            self._run.finish()


class MLflowSink(Sink):
    """Write to a run of MLflow at its tracking URI: pictures as ``images/NAME/STEP.png``, texts as ``NAME.txt``.

    MLflow has no histograms: they become their medians. It refuses some characters in names, which are left out.
    Pictures need Pillow.

    Args:
        run: what ``mlflow.start_run`` returned, which stays active; by default a new run.
        experiment: id of the experiment of a new run, by default MLflow's own.
    """

    def __init__(self, run: Any = None, *, experiment: str = "0") -> None:
        self._client, self._own = _library("mlflow").MlflowClient(), run is None
        self._run = (self._client.create_run(experiment) if run is None else run).info.run_id

    def _log(self, name: str, x: Any, step: int) -> None:
        if isinstance(x, str):
            self._client.log_text(self._run, x, f"{name}.txt")
        elif np.ndim(x) == 3:
            self._client.log_image(self._run, x, f"images/{name}/{step:06d}.png")
        else:
            # Of a histogram (N,) only the median is left, and its name says so; a number keeps its own.
            name += " median" * np.ndim(x)
            self._client.log_metric(self._run, re.sub(r"[^\w\-. /]", "", name), float(np.median(x)), step=step)

    def close(self) -> None:
        """End a run that was made here."""
        if self._own:
            self._client.set_terminated(self._run)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"this needs {name}, which is not installed: pip install {name}.") from error
