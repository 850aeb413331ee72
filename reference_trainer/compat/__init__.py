"""Public interfaces of CUDA rasterizers, backed by the reference renderer, for repositories that expect CUDA."""

from reference_trainer.compat.installation import stand_in

__all__ = ["stand_in"]
