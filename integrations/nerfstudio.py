"""`splatfacto-ca`, a method of nerfstudio: splatfacto with dropout, opacity noise and the co-adaptation score.

Nothing has to be imported: where both packages are installed, ``ns-train splatfacto-ca --data ...`` trains it, with
``--pipeline.model.dropout``, ``--pipeline.model.opacity-noise``, ``--pipeline.model.regularizer``,
``--pipeline.model.opacity-decay``, ``--pipeline.model.smooth-depth`` and ``--pipeline.model.ca-samples`` besides the
options of splatfacto. Evaluation images are logged with ``ca``, ``ca_std_error`` and ``ca_visible``, the share of
visible pixels; where that is 0, ``ca`` is nan.

The score is the paper's, keeping half as many Gaussians as training did, except that splatfacto clamps its colors.
Exported PLY files hold the opacities as trained; viewers other than nerfstudio's have to scale them by 1 - dropout.

The names of this module are created on access:

- ``splatfacto_ca``: the ``MethodSpecification``. nerfstudio loads it in every ``ns-train``, whatever the method, and an
  exception would end that; if it cannot be created this is an :class:`Unavailable`, which nerfstudio reports in one
  line before it continues.
- ``SplatfactoCAModel``, ``SplatfactoCAModelConfig``: for custom methods. If they are not available, access raises an
  ImportError.
"""

from __future__ import annotations

from typing import Any

__all__ = ["SplatfactoCAModel", "SplatfactoCAModelConfig", "Unavailable", "splatfacto_ca"]  # noqa: F822


class Unavailable:
    """Stands in for the method where it is not available; its ``repr`` says why."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def __repr__(self) -> str:
        text = (
            "splatfacto-ca (which needs nerfstudio 1.1.1 or newer with its gsplat, the extra nerfstudio of ca_reg: "
            f"{type(self.error).__name__}: {self.error})"
        )
        # nerfstudio prints this with rich, which parses square brackets as markup and raises if they do not match.
        return text.replace("[", "(").replace("]", ")")


def __getattr__(name: str) -> Any:
    if name not in ("SplatfactoCAModel", "SplatfactoCAModelConfig", "splatfacto_ca"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from . import _splatfacto_method

        return _splatfacto_method.make_method() if name == "splatfacto_ca" else getattr(_splatfacto_method, name)
    except Exception as error:  # whatever an incompatible nerfstudio raises
        unavailable = Unavailable(error)
        if name == "splatfacto_ca":
            return unavailable
        raise ImportError(f"{name} belongs to {unavailable}") from error
