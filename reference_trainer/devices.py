"""Checking the device that the command line names."""

from __future__ import annotations

__all__ = ["check_device"]


def check_device(name: str, *, here: bool = True) -> None:
    """Refuse a device, such as ``"cuda:1"``, that PyTorch cannot compute on; unless ``here``, check its name alone.

    Raises:
        ValueError: if the name is not that of a device, or if ``here`` and this machine cannot compute on it.

    Example:
        >>> check_device("cpu")
        >>> check_device("gpu")
        Traceback (most recent call last):
        ...
        ValueError: --device must be cpu, cuda or the number of a card as in cuda:1, got 'gpu'.
    """
    import torch

    try:
        device = torch.device(name)
    except RuntimeError as error:
        message = f"--device must be cpu, cuda or the number of a card as in cuda:1, got {name!r}."
        raise ValueError(message) from error
    if not here:
        return
    if device.type == "cuda":  # allocate nothing: workers may be the ones that compute
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (device.index or 0) >= count:
            raise ValueError(f"--device {name}: PyTorch {torch.__version__} finds {count} CUDA devices; take cpu.")
        return
    try:
        float(torch.ones((), dtype=torch.float64, device=device))  # scores need float64, which mps lacks
    except Exception as error:  # every backend has its own
        reason = str(error).partition("\n")[0].partition(". ")[0].rstrip(".")
        raise ValueError(f"--device {name}: PyTorch {torch.__version__} cannot compute there ({reason}).") from error
