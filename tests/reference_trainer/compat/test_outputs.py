"""What the values of a rasterizer are taken for, and what happens to those that are not known."""

import copy
import operator
import re

import numpy as np
import pytest
import torch

from reference_trainer.compat.outputs import SAY_IT, Planes, Unknown, kinds_of


@pytest.mark.parametrize(
    ("names", "fields", "kinds"),
    [
        ("image, radii", (), ()),
        ("rendered_image, radii, depth", (), ("depth",)),
        ("rendered_image, radii, depth_image", (), ("depth",)),
        ("rendered_image, radii, depth_image", ("antialiasing",), ("inverse_depth",)),
        ("color, radii, invdepths", (), ("inverse_depth",)),
        ("rendered_image, radii, rendered_depth, rendered_alpha", ("confidence",), ("depth", "alpha")),
        ("rendered_image, radii, depth, self.render_alphas", (), ("depth", "alpha")),
        ("image, radii, allmap", (), ("depth+alpha+normal+mean_depth+distortion",)),
        ("image, radii, gs_w", (), ("weights",)),
        ("image, radii, is_used", (), (None,)),
        ("image, radii, depth+is_used", (), (None,)),
        ("image, radii, counts, depths, accum_weights", (), (None, None, None)),
        ("image, radii, counts, depths, accum_weights", ("pixel_weights",), (None, "depths", "accum_weights")),
        ("image, radii, _, _", (), (None, None)),
        (None, ("confidence",), ("depth", "alpha")),
        (None, ("antialiasing",), ("inverse_depth",)),
    ],
)
def test_values_are_told_by_their_names_and_by_the_settings(names, fields, kinds):
    assert kinds_of(names and tuple(names.split(", ")), set(fields)) == ("image", "radii", *kinds)


@pytest.mark.parametrize(
    ("names", "kinds"),
    [
        ("rendered_image, infl, radii, depth", ("image", None, "radii", "depth")),
        ("gaussians_count, important_score, rendered_image, radii", (None, None, "image", "radii")),
        ("rendering, counts, radii", ("image", None, "radii")),
        ("0, 1, 2", ("image", "radii", None)),
        ("color+normals+depth, radii, pixels", ("image+normal+depth", "radii", "pixels")),
    ],
)
def test_image_and_radii_are_where_their_names_are(names, kinds):
    assert kinds_of(tuple(names.split(", ")), set()) == kinds


def test_every_kind_that_the_advice_lists_can_be_said():
    listed = re.search(r"of (depth, .*? and \w+), and \+", SAY_IT)[1]
    names = tuple(re.split(r", | and ", listed))
    assert {"depth", "heaviest", "largest_weight"} <= set(names)
    kinds = kinds_of(("image", "radii", *names), set())
    assert None not in kinds
    assert len(set(kinds)) == len(kinds)


def test_what_nothing_tells_is_asked_for():
    with pytest.raises(ValueError, match=r"unpack: .*--outputs: .*image,radii,depth"):
        kinds_of(None, set())


@pytest.mark.parametrize(
    "use",
    [
        lambda x: x[1:2],
        lambda x: x.detach(),
        lambda x: x + 1,
        lambda x: 2.0 * x,
        lambda x: torch.ones(3) * x,
        lambda x: torch.ones(3) > x,
        lambda x: torch.stack([torch.ones(3), x]),
        lambda x: torch.relu(input=x),
        lambda x: x > 0,
        lambda x: x >= 0,
        lambda x: x == 0,
        lambda x: x != 0,
        lambda x: 1 - x,
        lambda x: x - 1,
        lambda x: 1 / x,
        lambda x: x**2,
        lambda x: ~x,
        lambda x: x & True,
        lambda x: operator.setitem(x, 0, 1),
        abs,
        bool,
        float,
        int,
        len,
        list,
        np.asarray,
    ],
)
def test_an_unknown_value_is_refused_once_it_is_used(use):
    held = {"kept": Unknown("counts")}["kept"]
    with pytest.raises(ValueError, match=r"output counts .*--outputs"):
        use(held)


def test_an_unknown_value_is_not_none():
    unknown = Unknown("counts")
    assert unknown != None  # noqa: E711
    assert (unknown == None) is False  # noqa: E711
    assert {unknown: 1}[unknown] == 1


@pytest.mark.parametrize("index", [3, slice(3, 6), slice(2, 5), (8, slice(None)), (slice(3, None), 0), (7, ..., None)])
def test_a_channel_that_a_picture_does_not_have_is_asked_for_by_its_number(index):
    with pytest.raises(ValueError, match=r"channel [3-8] .* renders 3 channels: .* --outputs: .* image\+normal"):
        torch.zeros(3, 4, 5).as_subclass(Planes)[index]


def test_a_picture_is_a_tensor_otherwise():
    plain = torch.rand(3, 4, 5, requires_grad=True)
    picture = (2 * plain).as_subclass(Planes)
    for index in (0, -1, slice(None), slice(0, 3), slice(1, -1), (..., 0), (0, 3), plain > 0.5, None, [2, 0]):
        assert torch.equal(picture[index], (2 * plain)[index])
    assert type(picture * 1) is type(picture.detach()) is torch.Tensor
    picture[0].sum().backward()
    assert torch.equal(plain.grad, torch.tensor([2.0, 0, 0])[:, None, None].expand(3, 4, 5))


def test_a_picture_is_copied_and_kept_as_a_tensor(tmp_path):
    picture = torch.rand(3, 4, 5).as_subclass(Planes)
    torch.save({"render": picture}, tmp_path / "render.pt")
    for other in (copy.deepcopy(picture), torch.load(tmp_path / "render.pt", weights_only=True)["render"]):
        assert type(other) is torch.Tensor
        assert torch.equal(other, picture)
        assert other.data_ptr() != picture.data_ptr()
