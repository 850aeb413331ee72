"""The error that ends a training."""

__all__ = ["TrainingStoppedError"]


class TrainingStoppedError(RuntimeError):
    """Training cannot go on; the message says why and what to try."""
