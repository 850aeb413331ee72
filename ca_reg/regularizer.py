"""The base class of every regularizer: what to draw, how to apply it, what to render at test time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor

from ca_reg._scheduled import Scheduled
from ca_reg.functional import Multiplier
from ca_reg.params import Draw, Params

__all__ = ["Learned", "Regularizer"]

Given = TypeVar("Given", Tensor, Params)


class Learned(NamedTuple):
    """A number per Gaussian that a regularizer learns; it is cloned, split, pruned and saved with its Gaussian.

    ``start`` is its first value, ``rate`` Adam's learning rate.
    """

    start: float
    rate: float


class Regularizer(Scheduled):
    """Changes what a rasterizer receives in training, and says what is to be rendered at test time.

    A regularizer of one's own is a subclass with ``draw`` and ``replay``; if it renders something else than the plain
    model at test time also ``expected``, and if its draws are independent factors of the opacities, ``multiplied``.
    With that it works wherever the package's own do: in the bundled trainer, the INRIA hook and its launcher, gsplat,
    splatfacto-ca, in a :class:`~ca_reg.Chain`, and as the masks of a :class:`~ca_reg.CAScore`. Droppers whose Gaussians
    are dropped independently of each other only say their rates: :class:`~ca_reg.IndependentDropout`.

    Called as a module it takes activated opacities, (N,) or (N, 1), or :class:`~ca_reg.Params`, and returns the same
    kind: a draw in ``train()``, the test-time value in ``eval()``.

    Attributes:
        needs: fields of :class:`~ca_reg.Params` beside the opacities that it reads or changes.
        learns: what it learns per Gaussian, by name; the bundled trainer alone can supply that.
        drops: whether it may set opacities to 0.
        renders_mean: whether its test-time value is the mean of its draws.
        last: the last draw; None if there was none, or in evaluation.
        step: the training step, set with :meth:`set_step`.

    Example:
        Every second Gaussian dims at random:

        >>> class Flicker(Regularizer):
        ...     drops = False
        ...     def draw(self, x, generator=None):
        ...         return Draw(torch.rand(len(x.opacities), generator=generator))
        ...     def replay(self, x, draw):
        ...         factor = torch.where(torch.arange(len(draw.value)) % 2 == 0, 1.0, draw.value)
        ...         return x._replace(opacities=x.opacities * factor)
        >>> flicker = Flicker()
        >>> flicker(torch.full((4,), 0.5))[::2]
        tensor([0.5000, 0.5000])
        >>> flicker.eval()(torch.full((4,), 0.5))
        tensor([0.5000, 0.5000, 0.5000, 0.5000])
    """

    needs: ClassVar[tuple[str, ...]] = ()
    learns: ClassVar[Mapping[str, Learned]] = {}
    drops: ClassVar[bool] = True
    renders_mean: bool = False
    last: Draw | None = None

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw for one training step; ``x`` is what the rasterizer would receive, no generator the global one."""
        raise NotImplementedError

    def replay(self, x: Params, draw: Draw) -> Params:
        """Return what the rasterizer receives after a draw; ``x`` itself if there is nothing to do."""
        raise NotImplementedError

    def expected(self, x: Params) -> Params:
        """Return what is rendered at test time: ``x`` itself unless a subclass says otherwise."""
        return x

    def multiplied(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return what to render, and the independent random factor on its alphas, that together are all draws.

        With it a score or a training of this regularizer can be exact: :class:`~ca_reg.functional.Multiplier`. None,
        the default, where the draws are not of this kind.
        """
        return None

    def test_multiplied(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return :meth:`multiplied` as of the test: the same, unless training goes by what it saw at a former step."""
        return self.multiplied(x)

    def regularize(self, x: Params, generator: torch.Generator | None = None) -> Params:
        """Draw, remember the draw in :attr:`last`, and apply it; what trainers and hooks call.

        Raises:
            ValueError: if ``x`` lacks something that the regularizer needs.
        """
        self.check_needs(x)
        self.last = self.draw(x, generator)
        return self.replay(x, self.last)

    def forward(self, x: Given, *, drawn: Draw | None = None, generator: torch.Generator | None = None) -> Given:
        """Return what to render.

        Args:
            x: activated opacities in [0, 1], shape (N,) or (N, 1), or all parameters.
            drawn: a former draw to apply again, instead of a new one; in training only.
            generator: source of the draw; the global state of the random numbers is then untouched.

        Returns:
            As ``x``; the very same object if there is nothing to do.

        Raises:
            TypeError: if the opacities are not a floating-point tensor.
            ValueError: if a shape is wrong, the opacities look like logits, something that is needed is missing, or a
                draw is to be replayed in evaluation.
        """
        self._check(x.opacities if isinstance(x, Params) else x)
        # A graph that read the step would not outlive it; it has the rate from a tensor.
        step = 0 if torch.compiler.is_compiling() else self.step
        params = x if isinstance(x, Params) else Params(x.reshape(-1) if x.ndim > 1 else x, step=step)
        if not self.training:
            if drawn is not None:
                raise ValueError("a draw was given in eval(), where nothing is drawn; call train() or leave it out.")
            if self.renders_mean:
                self.check_needs(params)
            self.last, out = None, self.expected(params)
        elif drawn is not None:
            self.last, out = drawn, self.replay(params, drawn)
        else:
            out = self.regularize(params, generator)
        if isinstance(x, Params):
            return out
        return x if out.opacities is params.opacities else out.opacities.view_as(x)

    def check_needs(self, x: Params) -> None:
        """Raise a ValueError unless all that it needs is there."""
        missing = [name for name in self.needs if getattr(x, name) is None]
        missing += [f"learned[{name!r}]" for name in self.learns if name not in (x.learned or {})]
        if missing:
            raise ValueError(
                f"{type(self).__name__} needs {', '.join(missing)} of the Gaussians, which the caller did not give: "
                f"pass Params(opacities, {', '.join(f'{name}=...' for name in self.needs or ('learned',))})."
            )

    @property
    def keep(self) -> Tensor | None:
        """Which Gaussians the last draw did not drop, shape (N,) bool; None if it dropped none."""
        return None if self.last is None else self.last.keep

    def mask_radii(self, radii: Tensor) -> Tensor:
        """Zero the radii of the Gaussians that the last call dropped, so that density control does not count them.

        If they were counted as seen, their mean gradient would shrink by ``1 - p`` and the threshold in effect rise by
        ``1 / (1 - p)``.

        The radii are those of all Gaussians as the rasterizer returned them, shape (N,) or (N, ...). Returns the same
        shape and dtype, the very same tensor if nothing was dropped.

        Raises:
            ValueError: if the number of Gaussians is not that of the last call.

        Example:
            >>> from ca_reg import GaussianDropout
            >>> dropout = GaussianDropout(p=0.5)
            >>> _ = dropout(torch.full((4,), 0.5))
            >>> radii = torch.tensor([3, 1, 2, 5])
            >>> torch.equal(dropout.mask_radii(radii) > 0, dropout.keep)
            True
        """
        keep = self.keep
        if keep is None:
            return radii
        if radii.shape[:1] != keep.shape:
            raise ValueError(
                f"radii must have the {keep.shape[0]} Gaussians of the last call as the first axis, got shape "
                f"{tuple(radii.shape)}; call mask_radii before Gaussians are added or removed."
            )
        return radii * keep.view(-1, *[1] * (radii.ndim - 1)).to(radii.device)
