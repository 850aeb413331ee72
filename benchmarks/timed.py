"""Run a module as ``python -m`` does, with other seeds than those in its source, no downloads, and time its training.

    python benchmarks/timed.py times.json 1 ca_reg.integrations.run --cpu train.py -s scene -m out

``times.json`` gets the processor seconds from the first step of an optimizer to the last; ``1`` is added to every seed
that the module gives to `random`, NumPy and torch. What FSGS asks of `torch.hub`, a network for depth, is the files
``depth/*.png`` of the scene given by ``-s``.
"""

from __future__ import annotations

import itertools
import json
import random
import runpy
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from PIL import Image
from torch.optim.optimizer import register_optimizer_step_post_hook

__all__ = ["main"]


def main(file: str, shift: str, module: str, *arguments: str) -> None:
    """Run the module; the file is written however it ends."""
    times: list[float] = []
    watch = register_optimizer_step_post_hook(lambda *_: times.append(time.process_time()))
    sys.argv = [module, *arguments]
    out = Path(file).resolve()
    try:
        with (
            patch.object(random, "seed", partial(_shifted, random.seed, int(shift))),
            patch.object(np.random, "seed", partial(_shifted, np.random.seed, int(shift))),
            patch.object(torch, "manual_seed", partial(_shifted, torch.manual_seed, int(shift))),
            patch.object(torch.hub, "load", lambda *_: _Depths(Path(arguments[arguments.index("-s") + 1], "depth"))),
        ):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        watch.remove()
        out.write_text(json.dumps({"seconds": times[-1] - times[0] if times else None}))


class _Depths(torch.nn.Module):
    """Whatever the picture, the files of a folder, in the order of the photographs."""

    dpt_transform = None

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.next = itertools.cycle([np.array(Image.open(file)) for file in sorted(folder.iterdir())])

    def forward(self, _: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(next(self.next)).float()[None]


def _shifted(original: Any, shift: int, seed: Any = None, *rest: Any) -> Any:
    return original(seed + shift if isinstance(seed, int) else seed, *rest)


if __name__ == "__main__":
    main(*sys.argv[1:])
