"""The option that chooses the rendering engine, and the command that compiles it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

__all__ = ["Device", "Draw", "Drawing", "Warmup"]


Device = Annotated[str, tyro.conf.arg(help='"cpu" or "cuda".')]


@dataclass(frozen=True)
class Drawing:
    """The rendering engine, for all commands that render."""

    engine: Literal["auto", "torch", "numba", "triton"] | None = None
    """What draws: "numba" (compiled; float32 on a CPU), "triton" (float32 on a card), "torch" (anything), or "auto",
    whichever fits. By default $CA_REG_ENGINE, or "auto"."""

    def begin(self, device: str, *, trains: bool = False) -> None:
        """Choose the engine of this process and its workers, and print which it is.

        Args:
            device: where to render.
            trains: whether all loops will be needed: those not compiled yet are then compiled now, with progress.
        """
        from reference_trainer.render import describe_engine, use_engine

        if self.engine is not None:
            use_engine(self.engine)
        print(f"Engine: {describe_engine(device)}", flush=True)
        if trains and device == "cpu":
            from reference_trainer.runs.warmup import warm_up

            warm_up(_say)


Draw = Annotated[Drawing, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class Warmup:
    """Compile the renderer's loops now, not at their first use.

    Needed once per machine and version.
    """

    drawing: Draw = field(default_factory=Drawing)

    def __call__(self) -> None:
        from reference_trainer.runs.warmup import warm_up

        self.drawing.begin("cpu")
        names = warm_up(_say)
        print(f"Compiled: {', '.join(names)}." if names else "Nothing is left to compile.")


def _say(text: str) -> None:
    print(text, flush=True)
