"""Adam over a changing set of Gaussians: the one place that resizes parameters and optimizer state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from reference_trainer.model.gaussians import Gaussians, positions
from reference_trainer.render.engine import engine_for

__all__ = ["GaussianOptimizer"]


class GaussianOptimizer:
    """Gaussians whose tensors are leaves, and the Adam optimizer that updates them.

    Args:
        gaussians: initial values; they are copied.
        rates: Adam's learning rate of each parameter, per step, by the names of `Gaussians.named`.

    Example:
        >>> start = Gaussians.from_points(torch.zeros(4, 3), torch.rand(4, 3), torch.ones(4), sh_degree=0)
        >>> optimizer = GaussianOptimizer(start, {name: 1e-3 for name, _ in start.named()})
        >>> optimizer.gaussians.means.sum().backward()
        >>> optimizer.step()
        >>> optimizer.select(torch.tensor([0, 2]))
        >>> len(optimizer.gaussians)
        2
    """

    def __init__(self, gaussians: Gaussians, rates: Mapping[str, float]) -> None:
        # Where Triton renders, one launch does what PyTorch takes two for every parameter for.
        self._in_one = engine_for(gaussians.means.device, gaussians.means.dtype).name == "triton"
        self.gaussians = gaussians.map(lambda x: self._leaf(x.clone()))
        groups = [{"params": [x], "lr": rates[name], "name": name} for name, x in self.gaussians.named()]
        # The INRIA code's epsilon: gradients of single Gaussians can be far below Adam's usual 1e-8.
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=True)

    def step(self) -> None:
        """Update all parameters and clear their gradients."""
        self._step_in_one() if self._in_one else self._adam.step()
        self.clear_gradients()

    def clear_gradients(self) -> None:
        """Forget the gradients without a step."""
        for _, x in self.gaussians.named():
            x.grad = None

    def set_means_rate(self, rate: float) -> None:
        """Set the learning rate of the means, world units per step."""
        self._group("means")["lr"] = rate

    def select(self, index: Tensor) -> None:
        """Keep only the Gaussians at ``index`` (bool mask or positions), with their optimizer state."""
        places = positions(index)
        self._rebuild(lambda name, x: x[places], lambda moment: moment[places])

    def append(self, new: Gaussians) -> None:
        """Add Gaussians; their optimizer state starts at zero."""
        count = len(new)
        added = dict(new.named())
        self._rebuild(
            lambda name, x: torch.cat([x, added[name]]),
            lambda moment: torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])]),
        )

    def set_opacity_logits(self, logits: Tensor) -> None:
        """Overwrite the opacity logits, shape (N,); their optimizer state stays."""
        with torch.no_grad():
            self.gaussians.opacity_logits.copy_(logits)

    def relocate(self, index: Tensor, new: Gaussians) -> None:
        """Overwrite the Gaussians at ``index`` (positions) with as many new ones; their optimizer state stays."""
        with torch.no_grad():
            for (_, x), (_, value) in zip(self.gaussians.named(), new.named(), strict=True):
                x[index] = value

    def forget(self, index: Tensor | slice, *names: str) -> None:
        """Clear the optimizer state of the Gaussians at ``index`` (bool mask or positions), for all or some names."""
        for name, x in self.gaussians.named():
            if not names or name in names:
                for key, value in self._adam.state[x].items():
                    if key != "step":
                        value[index] = 0

    def state_dict(self) -> dict[str, Any]:
        """Return parameters and moments as plain tensors, for a checkpoint."""
        moments = {
            name: {
                key: value.clone() if isinstance(value, Tensor) else torch.tensor(float(value))
                for key, value in self._adam.state[x].items()
            }
            for name, x in self.gaussians.named()
        }
        return {"gaussians": {name: x.detach().clone() for name, x in self.gaussians.named()}, "moments": moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._replace({name: self._leaf(x.clone()) for name, x in state["gaussians"].items()})
        for name, x in self.gaussians.named():
            self._adam.state[x] = {
                key: int(value) if self._in_one and key == "step" else value.detach().clone()
                for key, value in state["moments"][name].items()
            }

    def _step_in_one(self) -> None:
        """Do what Adam does, to the rounding, in one launch for six tensors."""
        from reference_trainer.model._adam_triton import adam_step

        by_step: dict[int, list[tuple[Tensor, Tensor, Tensor, Tensor, float]]] = {}
        for group in self._adam.param_groups:
            (x,) = group["params"]
            if x.grad is None:
                continue
            state = self._adam.state[x]
            if not state:
                state |= {"step": 0, "exp_avg": torch.zeros_like(x), "exp_avg_sq": torch.zeros_like(x)}
            state["step"] += 1
            given = x, x.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"], group["lr"]
            by_step.setdefault(state["step"], []).append(given)
        options = self._adam.defaults
        for step, tensors in by_step.items():  # one, unless some have had no gradient
            adam_step(tensors, step, options["betas"], options["eps"])

    def _leaf(self, x: Tensor) -> Tensor:
        """Return a parameter to be trained; the kernel walks through it as it lies in memory."""
        x = x.detach()
        return (x.contiguous() if self._in_one else x).requires_grad_()

    def _group(self, name: str) -> dict[str, Any]:
        return next(group for group in self._adam.param_groups if group["name"] == name)

    def _replace(self, tensors: dict[str, Tensor]) -> None:
        """Make these leaves the parameters; the caller must set their optimizer state."""
        # Adam's state is keyed by the tensors themselves, and would keep the old ones alive.
        self._adam.state.clear()
        for name, x in tensors.items():
            self._group(name)["params"] = [x]
        self.gaussians = Gaussians.from_named(tensors)

    def _rebuild(self, parameter: Any, moment: Any) -> None:
        """Replace every parameter and its two moments by functions of the old ones."""
        # "step" is one number per tensor, which no resizing changes.
        old = {name: self._adam.state[x] for name, x in self.gaussians.named()}
        with torch.no_grad():
            self._replace({n: self._leaf(parameter(n, x)) for n, x in self.gaussians.named()})
            for name, x in self.gaussians.named():
                self._adam.state[x] = {
                    key: value if key == "step" else moment(value) for key, value in old[name].items()
                }
