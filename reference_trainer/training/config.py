"""The settings of a training run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

__all__ = ["TrainConfig"]


@dataclass(frozen=True)
class TrainConfig:
    """Settings of one training run. The defaults are those of the recipe ``3dgs``, but 3,000 iterations.

    Steps at which something begins are those of the recipe's own 10,000; `with_recipe` scales them, as commands do.

    Raises:
        TypeError: if a number of steps, models, Gaussians or bands, or the seed, is no integer, or another setting of
            another type.
        ValueError: if a setting is out of range, or two contradict each other.
    """

    iterations: int = 3_000
    """Optimization steps, one view each."""
    seed: int = 0
    """Decides everything random: the order of views, masks, noise and splits."""

    dropout: float = 0.0
    """Rate p of Gaussian dropout, in [0, 1); at test time opacities are scaled by 1 - p."""
    noise: float = 0.0
    """Standard deviation sigma of the multiplicative opacity noise; the paper uses up to 0.8."""
    regularizer: str = ""
    """Other regularizers: "d2gs", "dropout(0.2, compensate=True) + noise(0.8, scale=True)", "my_module:MyDropout(0.3)";
    `ca-reg names` lists them."""
    analytic: bool = False
    """Train on the expectation over the regularizers, computed exactly, instead of one random draw."""
    regularize_from: int = 0
    """Number of steps before the regularizers begin; fewer than all if there are any."""
    loss: str = "photometric"
    """Terms of the loss, such as "photometric(0.2) + co_adaptation(3.0)", or "my_module:MyTerm"."""
    density: str = "adaptive"
    """Density control, such as "absgrad" or "share_pruning(every=500)", or "my_module:MyStrategy"; `ca-reg names` lists
    them."""
    guard: int = 0
    """Steps between removals of Gaussians that hang where nobody took a photograph, the last one after the last step;
    all steps: that alone; 0 never. Only models with a regularizer are guarded, of two views or more."""
    models: int = 1
    """Models that are trained side by side and compared with each other, 2 for CoR-GS and SE-GS; the first is kept."""
    random_background: Literal["off", "auto", "on"] = "off"
    """Train over a background color drawn anew at each step, which penalizes transparency (CoR-GS, SE-GS); photographs
    with an alpha channel lie over it, too, so that what is empty stays empty; auto: unless the photographs show the
    scene's background."""
    renderer: str = "builtin"
    """Renderer of the training: "builtin", this package's own, "gsplat", which needs gsplat and a CUDA device, or
    "my_module:MyRenderer"."""

    sh_degree: int = 3
    """Degree of the spherical harmonics of the colors, 0 to 3."""
    sh_every: int = 500
    """Steps until another band of spherical harmonics is added; 0: all are there from the first step on."""

    means_rate: float = 1.6e-4
    """Initial learning rate of the means, in units of the scene's extent."""
    means_rate_final: float = 1.6e-6
    """Learning rate of the means after the last step, to which it decays exponentially."""
    scales_rate: float = 5e-3
    """Learning rate of the logarithms of the scales."""
    quaternions_rate: float = 1e-3
    """Learning rate of the orientations."""
    opacity_rate: float = 0.05
    """Learning rate of the opacity logits."""
    color_rate: float = 2.5e-3
    """Learning rate of the constant color; the other bands get a twentieth."""

    initial_points: Literal["all", "seen"] = "all"
    """Points to start from: all, or those whose Gaussian has a pixel in a training view."""
    initial_scale: float = 1.0
    """Size of the initial Gaussians, as a fraction of the distance to their neighbors."""
    initial_opacity: float = 0.1
    """Opacity of the initial Gaussians."""
    densify_from: int = 500
    """Densification begins after this step."""
    densify_until: int | None = None
    """Step before which densification, pruning and resets end; None: the last step."""
    densify_every: int = 100
    """Steps between densifications; 0 never densifies."""
    densify_gradient: float = 5e-4
    """Gaussians whose mean projected gradient reaches this are cloned or split."""
    dense_fraction: float = 0.01
    """Gaussians larger than this fraction of the scene's extent are split, smaller ones cloned."""
    prune_opacity: float = 0.005
    """Fainter Gaussians are removed at each densification."""
    prune_size: float | None = None
    """Gaussians larger than this fraction of the scene's extent are removed as well; None keeps them."""
    prune_size_from: int = 3_000
    """Only densifications after this step remove large Gaussians."""
    max_gaussians: int | None = None
    """No Gaussians are added once there are this many; None: no limit."""

    opacity_reset: float = 0.05
    """Higher opacities are lowered to this at a reset."""
    opacity_reset_from: int = 2_001
    """Step of the first reset."""
    opacity_reset_every: int = 3_000
    """Steps between resets; 0 never resets."""
    opacity_reset_over_white: bool = False
    """Over a white background, opacities are reset when density control begins as well."""
    opacity_decay: float = 1.0
    """Opacities are multiplied by this at every step from the beginning of density control on; 1 does nothing."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            name, value, kind = field.name, getattr(self, field.name), str(field.type).removesuffix(" | None")
            if isinstance(value, float) and not math.isfinite(value):  # JSON has no word for it
                raise ValueError(f"{name} must be finite, got {value}.")
            if value is None and kind != field.type:
                continue
            # No checkpoint with another one could be written, or read. A bool is no number here.
            if kind == "int" and type(value) is not int:
                raise TypeError(f"{name} must be an integer, got {value!r}: convert it with int().")
            if kind == "float" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise TypeError(f"{name} must be a number of Python's, got {value!r}: convert it with float().")
            if kind in ("str", "bool") and not isinstance(value, str if kind == "str" else bool):
                raise TypeError(f"{name} must be a {kind} of Python's, got {value!r}.")
        for names, right, rule, hint in _RANGES:
            for name in names:
                if not right(getattr(self, name)):
                    raise ValueError(f"{name} must be {rule}, got {getattr(self, name)!r}{hint}.")
        if self.analytic and not self.regularizers:
            raise ValueError("analytic training needs something to average over: set dropout, noise or regularizer.")
        if self.regularize_from >= self.iterations and self.regularizers:
            raise ValueError(
                f"regularize_from must be below iterations ({self.iterations}), got {self.regularize_from}: no step "
                "would use the regularizers."
            )

    @property
    def regularizers(self) -> str:
        """All regularizers as one expression, dropout and noise first."""
        own = [f"{name}({rate})" for name, rate in (("dropout", self.dropout), ("noise", self.noise)) if rate]
        return " + ".join([*own, *([self.regularizer] if self.regularizer.strip() else [])])

    @property
    def densify_end(self) -> int:
        """The step before which densification, pruning and resets end."""
        return self.iterations if self.densify_until is None else min(self.densify_until, self.iterations)

    def means_rate_at(self, step: int) -> float:
        """Learning rate of the means at a step, the first being 0, in scene extents; it decays exponentially.

        Example:
            >>> round(TrainConfig().means_rate_at(1500), 7)  # half way
            1.6e-05
        """
        # Linear in the logarithm.
        along = step / self.iterations
        return math.exp((1 - along) * math.log(self.means_rate) + along * math.log(self.means_rate_final))

    def sh_degree_at(self, number: int) -> int:
        """Highest band of spherical harmonics of the step with this number, the first being 1."""
        return min(self.sh_degree, number // self.sh_every) if self.sh_every else self.sh_degree


_RANGES: tuple[tuple[tuple[str, ...], Callable[[Any], bool], str, str], ...] = (
    (("iterations", "models"), lambda x: x >= 1, "at least 1", ""),
    (("dropout",), lambda x: 0 <= x < 1, "in [0, 1)", ": 0 turns it off"),
    (("noise",), lambda x: x >= 0, "at least 0", ": 0 turns it off"),
    (("seed",), lambda x: 0 <= x < 2**63, "in [0, 2^63)", ""),
    (("guard", "regularize_from", "sh_every", "densify_from", "densify_every", "opacity_reset_from",
      "opacity_reset_every", "prune_size_from", "densify_gradient", "dense_fraction", "prune_opacity", "scales_rate",
      "quaternions_rate", "opacity_rate", "color_rate"), lambda x: x >= 0, "at least 0", ""),
    (("max_gaussians", "densify_until"), lambda x: x is None or x >= 0, "None or at least 0", ""),
    (("sh_degree",), lambda x: x in (0, 1, 2, 3), "0, 1, 2 or 3", ""),
    (("initial_points",), lambda x: x in ("all", "seen"), "all or seen", ""),
    (("random_background",), lambda x: x in ("off", "auto", "on"), "off, auto or on", ""),
    (("prune_size",), lambda x: x is None or x > 0, "positive, or None to keep what is large", ""),
    (("means_rate", "means_rate_final", "initial_scale"), lambda x: x > 0, "positive", ""),
    (("initial_opacity", "opacity_reset"), lambda x: 0 < x < 1, "in (0, 1)", ""),
    (("opacity_decay",), lambda x: 0 < x <= 1, "in (0, 1]", ": 1 turns it off"),
)  # fmt: skip
"""Fields, the condition on their values, and the words and hint for errors."""
