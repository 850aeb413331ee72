"""Every form in which a render callable may answer."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ca_reg.types import Rendering, read_alpha_pass, read_rendering

H, W = 4, 6
IMAGE = torch.rand(3, H, W, generator=torch.Generator().manual_seed(0))
ALPHA = torch.rand(H, W, generator=torch.Generator().manual_seed(1))

FORMS = {
    "tuple": lambda i, a: (i, a),
    "swapped": lambda i, a: (a, i),
    "list": lambda i, a: [i, a],
    "named tuple": lambda i, a: Rendering(i, a),
    "ours": lambda i, a: {"image": i, "alpha": a},
    "inria": lambda i, a: {"render": i, "rendered_alpha": a, "radii": torch.ones(9), "depth": a * 0},
    "nerfstudio": lambda i, a: {"rgb": i, "accumulation": a, "depth": a * 0, "background": None},
    "object": lambda i, a: SimpleNamespace(rgb=i, alpha=a),
}
ALPHAS = {"(H, W)": lambda a: a, "(1, H, W)": lambda a: a[None], "(H, W, 1)": lambda a: a[..., None]}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("plane", ALPHAS.values(), ids=ALPHAS)
@pytest.mark.parametrize("layout", ["CHW", "HWC"])
@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_all_forms_read_the_same(form, plane, layout, kind):
    image, alpha = IMAGE if layout == "CHW" else IMAGE.permute(1, 2, 0), plane(ALPHA)
    if kind == "numpy":
        image, alpha = image.numpy(), alpha.numpy()
    read = read_rendering(form(image, alpha), layout=layout)
    assert torch.equal(read.image, IMAGE)
    assert torch.equal(read.alpha, ALPHA)


@pytest.mark.parametrize("form", [lambda i: i, lambda i: (i,), lambda i: {"render": i}, lambda i: Rendering(i)])
def test_an_image_alone_has_no_alpha(form):
    read = read_rendering(form(IMAGE))
    assert torch.equal(read.image, IMAGE)
    assert read.alpha is None


def test_a_batch_of_one_is_dropped_as_gsplat_returns_it():
    read = read_rendering((IMAGE.permute(1, 2, 0)[None], ALPHA[None, ..., None]), layout="HWC")
    assert torch.equal(read.image, IMAGE)
    assert torch.equal(read.alpha, ALPHA)


def test_numpy_arrays_may_be_read_only_or_flipped():
    image = np.flip(IMAGE.numpy(), axis=1)
    image.flags.writeable = False
    np.testing.assert_array_equal(read_rendering(image).image.numpy(), image)


@pytest.mark.parametrize("size", [(3, 5), (3, 3), (1, 3), (3, 1)])
def test_pictures_three_pixels_wide_or_high_are_not_confused(size):
    image, alpha = torch.rand(3, *size), torch.rand(1, *size)
    for result in ((image, alpha), (alpha, image)):
        read = read_rendering(result)
        assert torch.equal(read.image, image)
        assert torch.equal(read.alpha, alpha[0])


@pytest.mark.parametrize(
    ("result", "layout", "error", "message"),
    [
        ((IMAGE, torch.ones(50)), "CHW", ValueError, "radii"),
        ((IMAGE, torch.ones(50), ALPHA, ALPHA), "CHW", ValueError, "Pick the two"),
        ((), "CHW", ValueError, "tuple of 0"),
        ((IMAGE, torch.ones(H + 1, W)), "CHW", ValueError, "alpha of its size"),
        ({"image": IMAGE, "alpha": torch.ones(W, H)}, "CHW", ValueError, r"\(H, W\) = \(4, 6\)"),
        (IMAGE, "HWC", ValueError, "set layout"),
        (torch.rand(4, H, W), "CHW", ValueError, "RGB"),
        (torch.rand(2, 3, H, W), "CHW", ValueError, "RGB"),
        ((IMAGE * 255).byte(), "CHW", TypeError, "8-bit"),
        ({"picture": IMAGE}, "CHW", TypeError, "keys picture"),
        (None, "CHW", TypeError, "NoneType"),
        ((IMAGE, {"meta": 1}), "CHW", TypeError, "member 1"),
        (IMAGE, "WHC", ValueError, "layout must be"),
    ],
)
def test_what_cannot_be_read_says_why(result, layout, error, message):
    with pytest.raises(error, match=message):
        read_rendering(result, layout=layout)


@pytest.mark.parametrize(
    "result", [ALPHA, ALPHA[None], ALPHA.numpy(), ALPHA.expand(3, H, W), (ALPHA.expand(3, H, W), ALPHA)]
)
def test_a_white_on_black_pass_is_the_alpha(result):
    torch.testing.assert_close(read_alpha_pass(result, IMAGE), ALPHA)


def test_a_white_on_black_pass_of_another_size_is_refused():
    with pytest.raises(ValueError, match="same size"):
        read_alpha_pass(torch.rand(3, H, W + 1), IMAGE)
