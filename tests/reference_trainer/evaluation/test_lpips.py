from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from reference_trainer.evaluation.lpips import LPIPS, load_lpips

ALEX = [(64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3)]
ALEX_NAMES = [f"features.{i}" for i in (0, 3, 6, 8, 10)]
ST_NAMES = ["net.slice1.0", "net.slice2.5", "net.slice3.9", "net.slice4.11", "net.slice5.13"]
VGG_WIDTHS = [64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
VGG_INDICES = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]


def random_state(names: list[str], shapes: list[tuple[int, int, int]], heads: list[int]) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, (out, into, size) in zip(names, shapes, strict=True):
        scale = (2 / (into * size * size)) ** 0.5  # keeps the features' size from stage to stage
        state[f"{name}.weight"] = scale * torch.randn(out, into, size, size, generator=generator)
        state[f"{name}.bias"] = 0.1 * torch.randn(out, generator=generator)
    for index, width in enumerate(heads):
        state[f"lin{index}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator)
    # A state dict need not be in the order of the layers.
    return dict(sorted(state.items(), key=lambda item: item[0][::-1]))


def alex_state() -> dict[str, Tensor]:
    return random_state(ALEX_NAMES, ALEX, [64, 192, 384, 256, 256])


def st_state() -> dict[str, Tensor]:
    return random_state(ST_NAMES, ALEX, [64, 192, 384, 256, 256])


def vgg_state() -> dict[str, Tensor]:
    shapes = [(out, into, 3) for out, into in zip(VGG_WIDTHS, [3, *VGG_WIDTHS[:-1]], strict=True)]
    return random_state([f"features.{i}" for i in VGG_INDICES], shapes, [64, 128, 256, 512, 512])


def pair(height: int = 40, width: int = 47) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image, target = torch.rand(2, 3, height, width, generator=generator)
    return image, target


def convolve(state: dict[str, Tensor], name: str, x: Tensor, padding: int, stride: int = 1) -> Tensor:
    weight, bias = state[f"{name}.weight"].double(), state[f"{name}.bias"].double()
    return functional.conv2d(x, weight, bias, stride, padding)


def blurred_half(x: Tensor) -> Tensor:
    """Blur with [1 2 1] / 4 in both axes and keep every second pixel, by numpy's reflection and slices."""
    p = np.pad(x.numpy(), ((0, 0), (0, 0), (2, 2), (2, 2)), mode="reflect")
    rows = (p[:, :, :-2] + 2 * p[:, :, 1:-1] + p[:, :, 2:]) / 4
    both = (rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]) / 4
    return torch.from_numpy(both[:, :, ::2, ::2].copy())


def distance(features: list[tuple[Tensor, Tensor]], state: dict[str, Tensor]) -> float:
    total = 0.0
    for index, (x, y) in enumerate(features):
        head = state[f"lin{index}.model.1.weight"].double().flatten()
        x, y = (z[0] / z[0].square().sum(0).sqrt() for z in (x, y))
        total += torch.einsum("c,chw->hw", head, (x - y) ** 2).mean().item()
    return total


def normalized(image: Tensor) -> Tensor:
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]).double(), torch.tensor([0.458, 0.448, 0.450]).double()
    return ((image.double() - shift[:, None, None]) / scale[:, None, None])[None]


def alex_features(state: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    x = [convolve(state, "features.0", normalized(image), 2, 4).relu()]
    x.append(convolve(state, "features.3", functional.max_pool2d(x[-1], 3, 2), 2).relu())
    x.append(convolve(state, "features.6", functional.max_pool2d(x[-1], 3, 2), 1).relu())
    x.append(convolve(state, "features.8", x[-1], 1).relu())
    return [*x, convolve(state, "features.10", x[-1], 1).relu()]


def st_features(state: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    x = [blurred_half(convolve(state, ST_NAMES[0], normalized(2 * image.double() - 1), 2)).relu()]
    x.append(convolve(state, ST_NAMES[1], blurred_half(functional.max_pool2d(x[-1], 3, 1)), 2).relu())
    x.append(convolve(state, ST_NAMES[2], blurred_half(functional.max_pool2d(x[-1], 3, 1)), 1).relu())
    x.append(convolve(state, ST_NAMES[3], x[-1], 1).relu())
    return [*x, convolve(state, ST_NAMES[4], x[-1], 1).relu()]


def vgg_features(state: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    x, features = normalized(image), []
    for block in ([0, 2], [5, 7], [10, 12, 14], [17, 19, 21], [24, 26, 28]):
        x = functional.max_pool2d(x, 2) if features else x
        for index in block:
            x = convolve(state, f"features.{index}", x, 1).relu()
        features.append(x)
    return features


@pytest.mark.parametrize(
    ("make", "features", "name"),
    [
        (alex_state, alex_features, "LPIPS (alex, [0, 1] inputs)"),
        (st_state, st_features, "ST-LPIPS (alex)"),
        (vgg_state, vgg_features, "LPIPS (vgg, [0, 1] inputs)"),
    ],
)
def test_equals_the_network_written_out_in_float64(make, features, name):
    state = make()
    image, target = pair()
    metric = LPIPS(state)
    expected = distance(list(zip(features(state, image), features(state, target), strict=True)), state)
    assert metric.name == name
    assert metric(image, target) == pytest.approx(expected, rel=1e-4)


def test_zero_for_equal_images_and_growing_with_the_noise():
    metric = LPIPS(st_state())
    image, noise = pair()
    assert metric(image, image) == 0
    values = [metric(image + amount * (noise - image), image) for amount in (0.05, 0.2, 0.8)]
    assert 0 < values[0] < values[1] < values[2]


def test_weights_from_a_file(tmp_path):
    torch.save(alex_state(), tmp_path / "alex.pth")
    image, target = pair()
    metric = load_lpips(tmp_path / "alex.pth")
    assert metric is not None
    assert metric(image, target) == LPIPS(alex_state())(image, target)


def test_the_wheel_is_found_by_its_list_of_files(tmp_path, monkeypatch):
    info, weights = tmp_path / "stlpips_pytorch-0.0.2.dist-info", tmp_path / "stlpips_pytorch" / "weights"
    info.mkdir()
    weights.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stlpips-pytorch\nVersion: 0.0.2\n")
    (info / "RECORD").write_text("stlpips_pytorch/__init__.py,,\nstlpips_pytorch/weights/alex_shift_tolerant.pth,,\n")
    (tmp_path / "stlpips_pytorch" / "__init__.py").write_text("raise RuntimeError('must not be imported')\n")
    torch.save(st_state(), weights / "alex_shift_tolerant.pth")
    monkeypatch.syspath_prepend(tmp_path)
    metric = load_lpips("installed")
    assert metric is not None
    assert metric.name == "ST-LPIPS (alex)"


def test_absent_weights(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.path", [])
    assert load_lpips(None) is None
    with pytest.raises(ValueError, match="No LPIPS weights"):
        load_lpips("installed")
    with pytest.raises(FileNotFoundError, match=r"not exist.*pip install"):
        load_lpips(tmp_path / "none.pth")


def test_wrong_files(tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(ValueError, match="PyTorch file"):
        load_lpips(path)
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match="holds a list"):
        load_lpips(path)


def test_incomplete_states():
    state = alex_state()
    with pytest.raises(ValueError, match=r"LPIPS trunk.*pip install"):
        LPIPS({})
    with pytest.raises(ValueError, match=r"lin3\.model\.1\.weight .*\(1, 256, 1, 1\), got none"):
        LPIPS({name: x for name, x in state.items() if not name.startswith("lin3")})
    with pytest.raises(ValueError, match=r"features\.6\.bias"):
        LPIPS({name: x for name, x in state.items() if name != "features.6.bias"})


def test_wrong_images():
    metric = LPIPS(alex_state())
    with pytest.raises(ValueError, match="share one shape"):
        metric(torch.zeros(3, 40, 40), torch.zeros(3, 40, 41))
    with pytest.raises(ValueError, match="at least 32 pixels"):
        metric(torch.zeros(3, 40, 31), torch.zeros(3, 40, 31))
