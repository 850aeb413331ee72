"""Where a :class:`ca_reg.CAMonitor` writes besides its own log: TensorBoard, Weights & Biases, MLflow, or your own."""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from torch import Tensor

__all__ = ["MLflowSink", "Sink", "Sinks", "WandbSink"]


class Sink(Protocol):
    """The methods of a TensorBoard ``SummaryWriter`` that are called; positional arguments only."""

    def add_scalar(self, name: str, value: float, step: int, /) -> Any:
        """Add a point of a curve."""

    def add_image(self, name: str, image: Tensor, step: int, /) -> Any:
        """Add a picture (3, H, W) in [0, 1]."""

    def add_histogram(self, name: str, values: Tensor, step: int, /) -> Any:
        """Add the distribution of numbers (N,)."""

    def add_text(self, name: str, text: str, step: int, /) -> Any:
        """Add text, such as the settings."""

    def flush(self) -> Any:
        """Write what is pending; called after every measurement."""

    def close(self) -> Any:
        """End the log."""


class Sinks(Sequence[Sink]):
    """Several sinks as one: a call of a method of :class:`Sink` goes to all of them."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def __getitem__(self, index: Any) -> Any:
        return self._sinks[index]

    def __len__(self) -> int:
        return len(self._sinks)

    def __getattr__(self, name: str) -> Any:
        if name not in Sink.__dict__ or name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: [getattr(sink, name)(*arguments) for sink in self._sinks]


class WandbSink:
    """Write to a run of Weights & Biases.

    Args:
        run: such as of ``wandb.init``, which stays open; by default a new one.
        init: of ``wandb.init`` for a new one: ``project=``, ``name=``, ``mode="offline"``.
    """

    def __init__(self, run: Any = None, **init: Any) -> None:
        self._wandb, self._own = _library("wandb"), run is None
        self._run = self._wandb.init(**init) if run is None else run
        self._run.define_metric("*", step_metric="step")  # a resumed training repeats steps, which W&B's own may not

    def add_scalar(self, name: str, value: float, step: int, /) -> None:
        """Add a point of a curve."""
        self._run.log({name: value, "step": step})

    def add_image(self, name: str, image: Tensor, step: int, /) -> None:
        """Add a picture (3, H, W) in [0, 1]."""
        self._run.log({name: self._wandb.Image(_pixels(image)), "step": step})

    def add_histogram(self, name: str, values: Tensor, step: int, /) -> None:
        """Add the distribution of numbers (N,)."""
        self._run.log({name: self._wandb.Histogram(values.detach().cpu().numpy()), "step": step})

    def add_text(self, name: str, text: str, step: int, /) -> None:
        """Add text to the configuration of the run."""
        self._run.config.update({name: text}, allow_val_change=True)

    def flush(self) -> None:
        """Do nothing: W&B writes by itself."""

    def close(self) -> None:
        """Finish a run that was made here."""
        if self._own:
            self._run.finish()


class MLflowSink:
    """Write to a run of MLflow at ``mlflow.set_tracking_uri``, which has no histograms: these become their median.

    Args:
        run: such as of ``mlflow.start_run``, which stays active; by default a new one.
        experiment: of a new one: its id, by default that of MLflow.
    """

    def __init__(self, run: Any = None, *, experiment: str = "0") -> None:
        self._client, self._own = _library("mlflow").MlflowClient(), run is None
        self._run = (self._client.create_run(experiment) if run is None else run).info.run_id

    def add_scalar(self, name: str, value: float, step: int, /) -> None:
        """Add a point of a curve; characters that MLflow refuses are left out of the name."""
        self._client.log_metric(self._run, re.sub(r"[^\w\-. /]", "", name), value, step=step)

    def add_image(self, name: str, image: Tensor, step: int, /) -> None:
        """Add a picture (3, H, W) in [0, 1] as ``images/NAME/STEP.png``; needs Pillow."""
        from PIL import Image

        self._client.log_image(self._run, Image.fromarray(_pixels(image)), f"images/{name}/{step:06d}.png")

    def add_histogram(self, name: str, values: Tensor, step: int, /) -> None:
        """Add the median of numbers (N,)."""
        self.add_scalar(f"{name} median", values.median().item(), step)

    def add_text(self, name: str, text: str, step: int, /) -> None:
        """Add text as ``NAME.txt``."""
        self._client.log_text(self._run, text, f"{name}.txt")

    def flush(self) -> None:
        """Do nothing: every call is written."""

    def close(self) -> None:
        """End a run that was made here."""
        if self._own:
            self._client.set_terminated(self._run)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"this needs {name}, which is not installed: pip install {name}.") from error


def _pixels(image: Tensor) -> Any:
    """Return an image (3, H, W) in [0, 1] as bytes (H, W, 3)."""
    return np.ascontiguousarray((image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy())
