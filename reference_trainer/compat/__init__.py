"""Public interfaces of CUDA rasterizers, backed by the reference renderer, for repositories that expect CUDA."""

from reference_trainer.compat.installation import install, stand_in, uninstall

__all__ = ["install", "stand_in", "uninstall"]
