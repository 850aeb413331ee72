"""What a rasterizer receives, and the base class of the regularizers that change it: draw, apply, test time."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor

from ca_reg._precision import at_least_single, without_autocast
from ca_reg.functional import Multiplier
from ca_reg.schedules import Scheduled

__all__ = ["Draw", "Learned", "Params", "Regularizer"]

_LOCK = threading.Lock()


class Params(NamedTuple):
    """The activated parameters of N Gaussians as a rasterizer receives them; a regularizer returns a modified copy.

    Only the opacities are required. A regularizer lists the other fields that it reads or changes in
    :attr:`Regularizer.needs <ca_reg.Regularizer.needs>`; callers that cannot supply one raise an error naming it.

    Convention: world coordinates; quaternions wxyz, not necessarily normalized; the view matrix is world to camera,
    OpenCV axes (x right, y down, z forward), applied from the left to column vectors.

    Attributes:
        opacities: in [0, 1], shape (N,).
        means: centers, world units, shape (N, 3).
        scales: standard deviations along the axes, world units, shape (N, 3).
        quaternions: orientations, shape (N, 4).
        sh: spherical-harmonic coefficients, constant band first, shape (N, K, 3).
        view_matrix: of the rendered camera, the first if there are several, shape (4, 4).
        learned: per-Gaussian values that regularizers learn, by name, each (N,).
        step: the training step, from 0 on, which schedules follow; None for that of the module or score that is called.

    Example:
        >>> import torch
        >>> x = Params(torch.full((4,), 0.5), means=torch.zeros(4, 3))
        >>> x._replace(opacities=x.opacities * 0.8).opacities
        tensor([0.4000, 0.4000, 0.4000, 0.4000])
    """

    opacities: Tensor
    means: Tensor | None = None
    scales: Tensor | None = None
    quaternions: Tensor | None = None
    sh: Tensor | None = None
    view_matrix: Tensor | None = None
    learned: Mapping[str, Tensor] | None = None
    step: int | None = None

    @property
    def depths(self) -> Tensor:
        """Depths of the centers along the camera's z axis, (N,), at least float32, negative behind the camera.

        A regularizer that reads them lists ``means`` and ``view_matrix`` in its ``needs``. Without gradients.

        Raises:
            ValueError: if there are no means or no view matrix, or it is that of several cameras.
        """
        if self.means is None or self.view_matrix is None:
            raise ValueError("depths need means and view_matrix; list both in the needs of the regularizer.")
        if self.view_matrix.shape != (4, 4):
            raise ValueError(f"view_matrix must have shape (4, 4), of one camera, got {tuple(self.view_matrix.shape)}.")
        means = at_least_single(self.means.detach())
        row = self.view_matrix.detach()[2].to(means)  # for column vectors, the third row is the viewing direction
        with without_autocast(means.device):  # which would round the product to 16 bits
            return means @ row[:3] + row[3]


class Draw(NamedTuple):
    """One draw of a regularizer, with all it takes to replay it.

    Attributes:
        value: whatever the regularizer's ``replay`` reads, such as a mask or noise; None for nothing.
        keep: True where a Gaussian was kept, shape (N,) bool; None if none was dropped. Density control must not count
            dropped Gaussians as seen.
    """

    value: Any = None
    keep: Tensor | None = None


Given = TypeVar("Given", Tensor, Params)


class Learned(NamedTuple):
    """A learned number per Gaussian, cloned, split, pruned and saved with its Gaussian.

    ``start`` is the initial value, ``rate`` Adam's learning rate.
    """

    start: float
    rate: float


class Regularizer(Scheduled):
    """Perturbs what a rasterizer receives in training, and defines what is rendered at test time.

    A custom regularizer is a subclass with ``draw`` and ``replay``; it also overrides ``expected`` if it does not
    render the plain model at test time, and ``alpha_factor`` if its draws are independent factors of the opacities. It
    then works wherever the package's own do. To drop Gaussians independently of each other, subclass
    :class:`~ca_reg.IndependentDropout` and define the rates only.

    A rate of at least 0, or a schedule of it, goes to ``super().__init__``, and ``self.rate_at(x.step)`` is the rate of
    a draw; with a schedule ``state_dict`` saves the step.

    Called as a module it takes activated opacities, (N,) or (N, 1), or :class:`~ca_reg.Params`, and returns the same
    type: under a new draw in ``train()``, the test-time value in ``eval()``. A ``generator=`` goes to the call.

    Attributes:
        needs: fields of :class:`~ca_reg.Params` besides the opacities that it reads or changes.
        learns: what it learns per Gaussian, by name; supported by the bundled trainer only.
        drops: whether it may set opacities to 0.
        renders_mean: whether its test-time value is the mean of its draws.
        rate_name: name of the argument that may follow a schedule, for errors and ``print``.
        last: the last draw; None if there was none, in evaluation, and in a copy. Each thread that calls the module has
            its own, except inside ``torch.compile``.
        step: the training step, set with :meth:`set_step`.

    Example:
        Dim every second Gaussian at random:

        >>> from ca_reg.functional import draw_numbers
        >>> class Flicker(Regularizer):
        ...     drops = False
        ...     def draw(self, x, generator=None):
        ...         factor = draw_numbers(torch.rand, len(x.opacities), generator, x.opacities.device)
        ...         factor[::2] = 1.0
        ...         return Draw(factor)
        ...     def replay(self, x, draw):
        ...         return x._replace(opacities=x.opacities * draw.value)
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
    _latest: Draw | None = None
    _by_thread: tuple[tuple[weakref.ref[threading.Thread], Draw | None], ...] = ()

    @property
    def last(self) -> Draw | None:
        """The last draw of the calling thread; that of any thread if this one has not called the module."""
        if torch.compiler.is_compiling():
            return self._latest
        thread = weakref.ref(threading.current_thread())  # the same object for a thread
        for caller, draw in self._by_thread:
            if caller is thread:
                return draw
        return self._latest

    @last.setter
    def last(self, draw: Draw | None) -> None:
        self._remember(draw)

    def _remember(self, draw: Draw | None) -> None:
        """Set :attr:`last`; an assignment to an attribute of a module takes longer than all of this."""
        if torch.compiler.is_compiling():
            self._latest, self._by_thread = draw, ()  # a graph knows no threads
            return
        thread = weakref.ref(threading.current_thread())
        with _LOCK:
            # A new tuple, because a shallow copy of the module shares the old one.
            others = [x for x in self._by_thread if x[0] is not thread and x[0]() is not None]
            vars(self).update(_latest=draw, _by_thread=(*others, (thread, draw)))

    def __getstate__(self) -> dict[str, Any]:
        # Without the draws, which may be part of the graph of a step and then cannot be copied.
        return {name: x for name, x in vars(self).items() if name not in ("_latest", "_by_thread")}

    def draw(self, x: Params, generator: torch.Generator | None = None) -> Draw:
        """Draw for one training step, for which ``x`` is what the rasterizer would receive without a regularizer.

        The generator may be on another device than ``x``: :func:`~ca_reg.functional.draw_numbers` draws on the one and
        returns on the other.
        """
        raise NotImplementedError

    def replay(self, x: Params, draw: Draw) -> Params:
        """Return what the rasterizer receives under a draw; ``x`` itself if the draw changes nothing."""
        raise NotImplementedError

    def expected(self, x: Params) -> Params:
        """Return what is rendered at test time: ``x`` itself unless overridden."""
        return x

    def alpha_factor(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return parameters, and the independent random factor on their alphas, that together reproduce the draws.

        Exact scores and penalties take this :class:`~ca_reg.functional.Multiplier`. None, the default, means that the
        draws have no such form.
        """
        return None

    def test_alpha_factor(self, x: Params) -> tuple[Params, Multiplier] | None:
        """Return :meth:`alpha_factor` for a finished model; override it only if training caches measurements."""
        return self.alpha_factor(x)

    def regularize(self, x: Params, generator: torch.Generator | None = None) -> Params:
        """Draw, store the draw in :attr:`last`, and apply it; trainers and hooks call this.

        Raises:
            ValueError: if ``x`` lacks a field that the regularizer needs.
        """
        self.check_needs(x)
        draw = self.draw(x, generator)
        self._remember(draw)
        return self.replay(x, draw)

    def forward(self, x: Given, *, drawn: Draw | None = None, generator: torch.Generator | None = None) -> Given:
        """Return what to render.

        Args:
            x: activated opacities in [0, 1], shape (N,) or (N, 1), or all parameters with such opacities. Without a
                step in these, that of :meth:`set_step` counts; inside ``torch.compile`` only for :meth:`rate_at`.
            drawn: an earlier draw to replay; in training only.
            generator: source of this draw; the global random state is then untouched. It belongs to the call, so that
                the random numbers of a step can depend on the step alone.

        Returns:
            The same type as ``x``; the very same object if nothing changes.

        Raises:
            TypeError: if the opacities are not a floating-point tensor.
            ValueError: if a shape is wrong, the opacities look like logits, a needed field is missing, or ``drawn`` is
                given in evaluation.
        """
        given = x if isinstance(x, Params) else Params(x)
        self._check(given.opacities)
        # Reading the step would recompile the graph at every step; the graph reads the rate from a tensor.
        step = self.step if given.step is None and not torch.compiler.is_compiling() else given.step
        flat = given.opacities.reshape(-1) if given.opacities.ndim > 1 else given.opacities
        params = given._replace(opacities=flat, step=step)
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
        opacities = given.opacities if out.opacities is flat else out.opacities.view_as(given.opacities)
        if not isinstance(x, Params):
            return opacities
        return x if out is params else out._replace(opacities=opacities, step=x.step)

    def check_needs(self, x: Params) -> None:
        """Raise a ValueError unless ``x`` has everything that the regularizer needs."""
        missing = [name for name in self.needs if getattr(x, name) is None]
        missing += [f"learned[{name!r}]" for name in self.learns if name not in (x.learned or {})]
        if missing:
            raise ValueError(
                f"{type(self).__name__} needs {', '.join(missing)} of the Gaussians, which the caller did not give: "
                f"pass Params(opacities, {', '.join(f'{name}=...' for name in self.needs or ('learned',))})."
            )

    @property
    def keep(self) -> Tensor | None:
        """Which Gaussians the last draw kept, shape (N,) bool; None if it dropped none."""
        last = self.last
        return None if last is None else last.keep

    def mask_radii(self, radii: Tensor) -> Tensor:
        """Zero the radii of the Gaussians that the last call dropped, so that density control does not count them.

        Counted as seen, they would raise the effective densification threshold by ``1 / (1 - p)``.

        Takes the radii of all Gaussians, shape (N,) or (N, ...); returns the very same tensor if nothing was dropped.

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
