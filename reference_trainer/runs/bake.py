"""Bake test-time opacities into a finished model, for viewers that know nothing of regularizers."""

from __future__ import annotations

from pathlib import Path

from reference_trainer.runs.run import save_for_viewers
from reference_trainer.runs.score_ply import of_plain_ply

__all__ = ["bake_ply"]


def bake_ply(source: Path, target: Path, *, regularizer: str | None = None) -> str:
    """Write a PLY with a model's test-time opacities, such as those times 1 - p after dropout p.

    A header comment records what was done, so that no program of this package does it again. The layout is that of
    `save_ply`; unknown properties are dropped.

    Args:
        source: the PLY of a model that was trained with regularizers, opacities plain.
        target: the file to write; it must not exist.
        regularizer: what it was trained with, such as ``"dropout(0.2)"``, if the PLY does not say.

    Returns:
        The expression of the regularizers.

    Raises:
        ValueError: if the regularizers are unknown or cannot be parsed, the test-time opacities are the plain ones or
            depend on the camera, or those of the source are test-time ones already.
        FileExistsError: if the target exists: plain opacities are needed to train on and are never overwritten.
        FileNotFoundError: if there is no source.

    Example:
        >>> import tempfile
        >>> import torch
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> from reference_trainer.model.ply import load_ply, save_ply
        >>> gaussians = Gaussians.from_points(torch.rand(5, 3), torch.rand(5, 3), torch.full((5,), 0.1), sh_degree=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plain, baked = Path(folder, "plain.ply"), Path(folder, "baked.ply")
        ...     save_ply(gaussians, plain)
        ...     _ = bake_ply(plain, baked, regularizer="dropout(0.2)")
        ...     load_ply(baked).opacity_scale
        0.8
    """
    if target.exists():
        raise FileExistsError(f"{target} exists already: give another --out, or delete it.")
    model, facts = of_plain_ply(source, regularizer=regularizer)
    if not facts.regularizer:
        raise ValueError(f"{source} does not say what it was trained with: give --regularizer, such as 'dropout(0.2)'.")
    if model.depends_on_camera:
        raise ValueError(f"what is rendered after {facts.regularizer} depends on the camera: no file can hold it.")
    if model.factor == 1:
        raise ValueError(f"a model trained with {facts.regularizer} is rendered as it is: there is nothing to bake.")
    save_for_viewers(model, target)
    return facts.regularizer
