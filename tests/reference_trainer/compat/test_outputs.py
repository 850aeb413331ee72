"""What the values of a rasterizer are taken for, and what happens to those that are not known."""

import pytest
import torch

from reference_trainer.compat.outputs import Unknown, kinds_of


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
        ("image, radii, allmap", (), ("surfels",)),
        ("image, radii, gs_w", (), ("weights",)),
        ("image, radii, is_used", (), (None,)),
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
    ],
)
def test_image_and_radii_are_where_their_names_are(names, kinds):
    assert kinds_of(tuple(names.split(", ")), set()) == kinds


def test_what_nothing_tells_is_asked_for():
    with pytest.raises(ValueError, match=r"does not unpack: say .* --outputs: .* image,radii,depth"):
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
        bool,
        len,
        list,
    ],
)
def test_an_unknown_value_is_refused_once_it_is_used(use):
    held = {"kept": Unknown("counts")}["kept"]
    with pytest.raises(ValueError, match=r"output counts is used, .* --outputs"):
        use(held)
