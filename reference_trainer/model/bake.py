"""Scale the opacities of a finished model for viewers, once."""

from __future__ import annotations

from pathlib import Path

from reference_trainer.model.ply import load_ply, save_ply

__all__ = ["bake_ply"]


def bake_ply(source: Path, target: Path, *, dropout: float) -> None:
    """Write a PLY with opacities times ``1 - dropout``, as a model trained with dropout is to be rendered.

    Viewers know nothing of dropout and would show the plain opacities. A header comment records the factor; with it, no
    program of this package scales again. The layout is that of `save_ply`; unknown properties are left out.

    Args:
        source: the PLY of a model that was trained with dropout, opacities plain.
        target: the file to write; it must not exist.
        dropout: the rate of the training, in (0, 1). A model of inverted dropout is rendered as it is: do not bake it.

    Raises:
        ValueError: if the rate is out of range, or the opacities of the source are scaled already.
        FileExistsError: if the target exists: plain opacities are needed to train on and are never overwritten.
        FileNotFoundError: if there is no source.

    Example:
        >>> import tempfile, torch
        >>> from reference_trainer.model.gaussians import Gaussians
        >>> gaussians = Gaussians.from_points(torch.rand(5, 3), torch.rand(5, 3), torch.full((5,), 0.1), sh_degree=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plain, baked = Path(folder, "plain.ply"), Path(folder, "baked.ply")
        ...     save_ply(gaussians, plain)
        ...     bake_ply(plain, baked, dropout=0.2)
        ...     load_ply(baked).opacity_scale
        0.8
    """
    if not 0 < dropout < 1:
        raise ValueError(f"--dropout is the rate of the training, in (0, 1); got {dropout:g}.")
    if target.exists():
        raise FileExistsError(f"{target} exists already: give another --out, or delete it.")
    loaded = load_ply(source)
    if loaded.for_rendering or loaded.opacity_scale != 1:
        by = "the mean of their noise" if loaded.for_rendering else f"{loaded.opacity_scale:g}"
        raise ValueError(f"the opacities of {source} are scaled by {by} already: give the PLY with plain ones.")
    save_ply(loaded.gaussians, target, bake_p=dropout)
