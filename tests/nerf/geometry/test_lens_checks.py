import math
from dataclasses import replace

import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.geometry.lens_checks import require_invertible

NONE = [0.0] * 6


def cameras_with(*lenses, model="radial_tangential", focal=60.0):
    c2w = torch.eye(4)[:3].repeat(len(lenses), 1, 1)
    return replace(pinhole_cameras(c2w, focal, 100, 80), lens=torch.tensor(lenses), lens_model=model)


def refused(cameras, *parts):
    names = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    with pytest.raises(InputError) as error:
        require_invertible(cameras, names[: len(cameras.lens)])
    message = str(error.value)
    for part in parts:
        assert part in message, message
    assert "\n" not in message


def test_lenses_that_are_used_pass():
    require_invertible(cameras_with([0.0578421, -0.0805099, 0.0, 0.0, -0.00098, 0.00016], NONE), ["a", "b"])
    require_invertible(cameras_with([-0.3, 0.1, 0.0, 0.0, 0.0, 0.0]), ["a"])
    require_invertible(cameras_with([0.0348, 0.0040, -0.0029, 0.0006, 0.0, 0.0], model="fisheye", focal=40.0), ["a"])
    require_invertible(cameras_with(NONE, model="pinhole"), ["a"])


def test_a_lens_that_folds_back_is_refused_by_the_name_of_its_views():
    folding = [-1.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    refused(
        cameras_with(NONE, folding, NONE, folding),
        "The lens of b.jpg (one of 2 views with this lens) folds back before it reaches pixel (",
        "model radial_tangential, k1=-1.5, focal length 60, 60 pixels, image 100 x 80",
        "`colmap image_undistorter`",
        "or crop them",
    )


def test_the_place_where_it_folds_is_named():
    """Where r = 1 / sqrt(-3 k1), r (1 + k1 r^2) is highest, and 2/3 of that: nothing further out has a ray."""
    k1 = -0.6
    last = 2 / 3 / math.sqrt(-3 * k1)
    require_invertible(cameras_with([k1, 0, 0, 0, 0, 0], focal=math.hypot(50, 40) / (0.98 * last)), ["a"])
    refused(cameras_with([k1, 0, 0, 0, 0, 0], focal=math.hypot(50, 40) / (1.05 * last)), "a.jpg", "pixel (")


def test_an_exact_inverse_beyond_a_fold_is_refused():
    """A crop far from the axis: its places come back exactly, from a branch that no real lens has."""
    rises_falls_rises = cameras_with([-1.2, 0.5, 0.0, 0.0, 0.0, 0.0], focal=100.0)
    crop = replace(rises_falls_rises, center=torch.tensor([[-150.0, 40.0]]))
    refused(crop, "folds back before it reaches pixel (")


def test_a_fisheye_that_would_see_more_than_everything():
    """The corners are 64 pixels from the axis: 3.05 radians at a focal length of 21 pixels, but 3.37 at 19."""
    require_invertible(cameras_with(NONE, model="fisheye", focal=21.0), ["a"])
    refused(cameras_with(NONE, model="fisheye", focal=19.0), "a.jpg", "pixel (", "model fisheye")


@pytest.mark.parametrize(
    ("lens", "model", "parts"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.01, 0.0], "fisheye", ("p1, p2, which the model fisheye", "p1=0.01")),
        ([math.nan, 0.0, 0.0, 0.0, 0.0, 0.0], "radial_tangential", ("has coefficients that are not finite",)),
        # The usual mistake with units: divided by nothing.
        ([-40.0, 12.0, 0.0, 0.0, 0.0, 0.0], "radial_tangential", ("for lengths in focal lengths, not in pixels",)),
    ],
)
def test_coefficients_that_no_lens_has_are_refused(lens, model, parts):
    refused(cameras_with(lens, model=model), *parts)
