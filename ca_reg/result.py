"""The results of a score, for one view and for the mean over views, and the reasons why there is none."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from enum import Enum
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["CAResult", "CASettings", "CASummary", "LimitEstimate", "Method", "Reason", "summarize"]


class Reason(Enum):
    """The outcome of a measurement: why a score has the value it has, as a message and a remedy.

    Every member but ``OK`` and ``NO_EFFECT``, whose value is 0, comes with the value nan. Files store ``reason.name``,
    such as ``"EMPTY"``; people read ``str(reason)``.

    Example:
        >>> Reason.OK.message
        'the value was measured'
        >>> print(Reason.NO_VIEWS)
        no view was measured; call update(opacity, view) before compute()
    """

    OK = ("the value was measured", "")
    EMPTY = (
        "no pixel counts: none is covered beyond the threshold",
        "lower the threshold or the drop rate; right after an opacity reset, or in a scene that is nowhere opaque, "
        "there is nothing to measure",
    )
    NOT_FINITE = (
        "NaN or infinity in an alpha, or in a color where the alpha is not 0",
        "look at the colors and opacities of the model: the training has diverged or the renderer is at fault",
    )
    OUT_OF_RANGE = (
        "the variance is above that of any colors in [0, 1]",
        "return images in [0, 1], not in 0..255; if they are, the colors of the model have diverged",
    )
    NO_EFFECT = (
        "no pixel changed in any render, although Gaussians were left out",
        "check that render_fn renders with the opacities that it is given, in place of the model's own",
    )
    NO_VIEWS = ("no view was measured", "call update(opacity, view) before compute()")

    def __init__(self, message: str, remedy: str) -> None:
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}" if self.remedy else self.message


_COUNTED = (Reason.EMPTY, Reason.NOT_FINITE, Reason.OUT_OF_RANGE, Reason.NO_EFFECT)
COLUMNS = 3 + len(_COUNTED)

Method = Literal["sampling", "adaptive", "exact", "exact_neutral"]
"""How a score was computed: see :class:`CASettings`."""


@dataclass(frozen=True, kw_only=True)
class CASettings:
    """The choices behind a score, without which it cannot be compared with another.

    The background matters as well (up to ``1 - threshold`` of it shows inside the visible region); the render callable
    decides it. Settings that do not apply to the method are None.

    Args:
        method: ``"sampling"``, a fixed number of renders; ``"adaptive"``, as many as the target error takes;
            ``"exact"``, infinitely many; ``"exact_neutral"``, the same over the expected color of each pixel.
        samples: number of renders K; also None for adaptive scores, where it is decided for each view.
        drop_rate: fraction of the Gaussians that each render drops; None if a regularizer drew instead.
        regularizer: the ``repr`` of the regularizer that drew instead of a dropout at ``drop_rate``; None for dropout.
        threshold: a pixel is visible where its alpha exceeds this: in all K renders with ``"sampling"``, in expectation
            with the other methods.
        ddof: the divisor of the variance is ``samples - ddof``. With 0 it expects (K - 1)/K of the true variance.
        seed: seed of the masks.
        relative_error: standard error, as a fraction of the score, at which adaptive sampling stops.
        max_samples: number of renders at which it stops in any case.
    """

    method: Method
    samples: int | None = None
    drop_rate: float | None = None
    regularizer: str | None = None
    threshold: float
    ddof: int | None = None
    seed: int | None = None
    relative_error: float | None = None
    max_samples: int | None = None


class LimitEstimate(NamedTuple):
    """What a score would be with infinitely many renders, for a given visible region, and its standard error."""

    value: float
    std_error: float


@dataclass(frozen=True, kw_only=True)
class _Score(CASettings):
    """A value with its standard error, and why it is what it is."""

    value: float
    std_error: float
    reason: Reason

    @property
    def settings(self) -> CASettings:
        """The choices behind the score, which are the same for every view of one :class:`~ca_reg.CAScore`."""
        values = {field.name: getattr(self, field.name) for field in fields(CASettings)}
        if self.method == "adaptive":
            values["samples"] = None  # found anew for each view, so no choice
        return CASettings(**values)

    @property
    def expected_fraction(self) -> float:
        """The expected score as a fraction of its limit for infinitely many renders, given the visible region.

        ``(K - 1) / (K - ddof)``: 0.8 for the paper's 5 renders with ``ddof=0``; 1 for scores without that bias.
        """
        if self.samples is None or self.ddof is None:
            return 1.0
        return (self.samples - 1) / (self.samples - self.ddof)

    @property
    def limit(self) -> LimitEstimate:
        """The score for infinitely many renders, as estimated from these: both numbers over ``expected_fraction``.

        It corrects the bias of the variance alone. The visible region of the paper's protocol favors pixels that vary
        little, so an exact or adaptive score can differ by more than the error.

        Example:
            >>> from ca_reg import CAScore
            >>> score = CAScore(lambda opacity, view: (opacity[:48].view(3, 4, 4), torch.ones(4, 4)))
            >>> result = score(torch.ones(50), view=None)
            >>> result.expected_fraction, round(result.limit.value / result.value, 6)
            (0.8, 1.25)
        """
        return LimitEstimate(self.value / self.expected_fraction, self.std_error / self.expected_fraction)

    def as_dict(self) -> dict[str, float | int | str | None]:
        """Return all numbers and strings, ready for JSON: nan becomes None, maps are left out."""
        out: dict[str, float | int | str | None] = {}
        for field in fields(self):
            x = getattr(self, field.name)
            if isinstance(x, Reason):
                out[field.name] = x.name
            elif not isinstance(x, Tensor):
                out[field.name] = None if isinstance(x, float) and math.isnan(x) else x
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class CAResult(_Score):
    """The co-adaptation score of one view.

    Args:
        value: the score: variance of the renders, mean over RGB and over the visible pixels; nan if there is none.
        std_error: standard error of ``value`` over the choice of masks; 0 for an exact score; nan if unknown.
        variance: variance of every pixel, mean over RGB, shape (H, W), float64, visible or not.
        visible: pixels that count, shape (H, W), bool.
        reason: why the value is what it is.

    The other fields are the settings of the score, see :class:`CASettings`; for an adaptive score ``samples`` is the
    number of renders that this view took.
    """

    variance: Tensor
    visible: Tensor

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the root of ``variance``, in units of color, as a heat map; pixels that do not count stay gray.

        The root, because a few pixels hold most of the variance.
        Draws on ``ax``, by default in a new figure, and returns it.

        Raises:
            ImportError: if matplotlib is missing; it comes with ``ca_reg[plot]``.
        """
        ax = new_axes() if ax is None else ax
        heat = self.variance.sqrt().masked_fill(~self.visible, math.nan).cpu().numpy()
        ax.set_facecolor("0.6")
        image = ax.imshow(heat, cmap="inferno", vmin=0.0)
        ax.figure.colorbar(image, ax=ax, label="std over masks")
        error = "exact" if self.samples is None else f"± {self.std_error:.1g}"
        ax.set_title(f"CA {self.value:.3g} {error}" if self.reason is Reason.OK else self.reason.message)
        ax.set_xticks([])
        ax.set_yticks([])
        return ax


@dataclass(frozen=True, kw_only=True)
class CASummary(_Score):
    """The mean co-adaptation score of several views.

    Args:
        value: mean over the views that have a value; else nan, see ``reason``.
        std_error: standard error of ``value`` over the choice of masks, the views held fixed.
        reason: ``NOT_FINITE`` or ``OUT_OF_RANGE`` if it holds for any view, ``EMPTY`` or ``NO_EFFECT`` if for all,
            ``NO_VIEWS`` without views, else ``OK``.
        views: number of views that were measured.
        empty_views: number of views without a visible pixel, which ``value`` leaves out.
    """

    views: int
    empty_views: int


def summarize(results: Iterable[CAResult]) -> CASummary:
    """Average the scores of several views of one model.

    Raises:
        ValueError: if there are no results, or their settings differ.

    Example:
        >>> from ca_reg import CAScore
        >>> score = CAScore(lambda opacity, view: (torch.rand(3, 4, 4), torch.ones(4, 4)))
        >>> summarize(score(torch.ones(10), view=None, index=i) for i in range(2)).views
        2
    """
    sums, settings = torch.zeros(COLUMNS, dtype=torch.float64, device="cpu"), set()
    for result in results:
        sums += row_of(result)
        settings.add(result.settings)
    if len(settings) != 1:
        raise ValueError(f"expected results of one score, with one set of settings, got {len(settings)} of them.")
    return summary_of(sums, settings.pop())


def row_of(result: CAResult) -> Tensor:
    """Encode a result as float64 numbers, (COLUMNS,), so that the results of views and ranks can be added.

    They are its value, its squared standard error, 1, and for each reason of `_COUNTED` whether it is that.
    """
    ok = result.reason is Reason.OK
    row = [result.value, result.std_error**2, 1.0] if ok else [0.0, 0.0, 1.0]
    row += [float(result.reason is reason) for reason in _COUNTED]
    return torch.tensor(row, dtype=torch.float64, device="cpu")


def summary_of(sums: Tensor, settings: CASettings) -> CASummary:
    """Return the mean over views, given the sum of their rows, (COLUMNS,)."""
    total, squared_error, views, empty, not_finite, out_of_range, no_effect = sums.tolist()
    counted = views - empty
    if views == 0:
        reason = Reason.NO_VIEWS
    elif not_finite > 0:  # one broken view is a fault of the model or the renderer, an empty one is not
        reason = Reason.NOT_FINITE
    elif out_of_range > 0:
        reason = Reason.OUT_OF_RANGE
    elif counted == 0:
        reason = Reason.EMPTY
    else:
        reason = Reason.NO_EFFECT if no_effect == counted else Reason.OK
    ok = reason in (Reason.OK, Reason.NO_EFFECT)
    return CASummary(
        value=total / counted if ok else math.nan,
        std_error=math.sqrt(squared_error) / counted if ok else math.nan,
        reason=reason,
        views=int(views),
        empty_views=int(empty),
        **asdict(settings),
    )


def view_position(count: int, group: dist.ProcessGroup | None = None) -> int:
    """Return the position, among the views of all ranks, of the view that follows ``count`` others on this rank."""
    if not (dist.is_available() and dist.is_initialized()):
        return count
    return dist.get_rank(group) + dist.get_world_size(group) * count


def new_axes(count: int = 1) -> Any:
    """Return the axes of a new figure, an array if ``count`` is above 1; raise ImportError without matplotlib."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("plots need matplotlib; install it with: pip install 'ca_reg[plot]'") from error
    return plt.subplots(1, count, figsize=(6.4 * count, 4.8), layout="constrained")[1]
