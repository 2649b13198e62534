import math
from dataclasses import replace

import pytest
import torch

from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, project, rays_through_pixels
from nerf_lightning.nerf.geometry.lens_checks import lens_faults
from nerf_lightning.nerf.geometry.lenses import project_plane, stretches, unproject
from nerf_lightning.nerf.geometry.poses import look_at

FOX = [0.0578421, -0.0805099, 0.0, 0.0, -0.000980296, 0.00015575]
STRONG = [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0]
GOPRO = [0.0348, 0.0040, -0.0029, 0.0006, 0.0, 0.0]
# Model, coefficients, width and height, fx and fy, cx and cy.
REAL = {
    "fox": ("radial_tangential", FOX, (540, 960), (687.76, 687.245), (277.279, 482.634)),
    "strong barrel": ("radial_tangential", STRONG, (1600, 1200), (800.0, 805.0), (790.0, 610.0)),
    "pincushion": ("radial_tangential", [0.3, 0.1, 0, 0, 0.001, -0.002], (640, 480), (400.0, 402.0), (316.0, 244.0)),
    "gopro": ("fisheye", GOPRO, (1920, 1440), (870.0, 870.0), (955.0, 722.0)),
    "fisheye of 190 degrees": ("fisheye", [-0.01, 0.002, 0, 0, 0, 0], (800, 800), (241.0, 241.0), (400.0, 400.0)),
}


def lens_camera(name, dtype=torch.float64):
    model, lens, size, focal, center = REAL[name]
    eye = torch.tensor([[3.0, -1.0, 2.0]], dtype=dtype)
    camera = pinhole_cameras(look_at(eye, torch.zeros_like(eye), eye.new_tensor([0.0, 0.0, 1.0])), 1.0, *size)
    values = [torch.tensor([value], dtype=dtype) for value in (focal, center, lens)]
    return replace(camera, focal=values[0], center=values[1], lens=values[2], lens_model=model)


def pixels_of(cameras, view=0, step=7):
    """Every `step`-th pixel of the image, and all of its border."""
    index = all_pixels(cameras, view)
    kept = (index.x % step == 0) & (index.y % step == 0)
    kept[[0, -1]] = True
    kept[:, [0, -1]] = True
    return index.map(lambda x: x[kept])


def rays_of(cameras, view=0):
    views = cameras.c2w.shape[0]
    return rays_through_pixels(cameras, pixels_of(cameras, view), torch.zeros(views), torch.ones(views))


def places(count=200, most=0.9, seed=0):
    return most * (2 * torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1)


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-4), (torch.float32, 5e-3)])
def test_pixels_of_the_whole_image_come_back_from_their_rays(name, dtype, tolerance):
    cameras = lens_camera(name, dtype)
    rays = rays_of(cameras)
    # At the origin the camera's own place costs no digits.
    centred = replace(cameras, c2w=torch.cat([cameras.c2w[..., :3], torch.zeros_like(cameras.c2w[..., 3:])], dim=-1))
    index = pixels_of(cameras)
    missed = project(centred, 0, rays.directions) - torch.stack([index.x, index.y], -1) - 0.5
    assert float(missed.abs().max()) < tolerance
    norms = rays.directions.norm(dim=-1)
    torch.testing.assert_close(norms, torch.ones_like(norms))


def test_an_equidistant_fisheye_measures_angles():
    none = torch.zeros(6, dtype=torch.float64)
    angle = torch.tensor([0.0, 0.3, math.pi / 2, 2.0], dtype=torch.float64)
    plane = torch.stack([torch.zeros_like(angle), angle], dim=-1)
    expected = torch.stack([torch.zeros_like(angle), angle.sin(), angle.cos()], dim=-1)
    torch.testing.assert_close(unproject(plane, none, "fisheye"), expected)
    torch.testing.assert_close(project_plane(7.0 * expected, none, "fisheye"), plane)


def test_the_formulas_of_opencv_in_numbers():
    """Worked by hand at (u, v) = (0.5, -0.25), r^2 = 0.3125; the fisheye at 45 degrees."""
    lens = torch.tensor([0.1, -0.2, 0.3, -0.4, 0.01, -0.02], dtype=torch.float64)
    r2 = 0.3125
    radial = 1 + 0.1 * r2 - 0.2 * r2**2 + 0.3 * r2**3 - 0.4 * r2**4
    u = 0.5 * radial + 2 * 0.01 * 0.5 * -0.25 - 0.02 * (r2 + 2 * 0.25)
    v = -0.25 * radial + 0.01 * (r2 + 2 * 0.0625) + 2 * -0.02 * 0.5 * -0.25
    shown = project_plane(torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64), lens, "radial_tangential")
    assert shown.tolist() == pytest.approx([u, v], abs=1e-12)
    t = math.pi / 4
    bent = t * (1 + 0.1 * t**2 - 0.2 * t**4 + 0.3 * t**6 - 0.4 * t**8)
    direction = torch.tensor([0.6, 0.8, 1.0], dtype=torch.float64)
    assert project_plane(direction, lens, "fisheye").tolist() == pytest.approx([0.6 * bent, 0.8 * bent], abs=1e-12)


def test_each_view_has_its_own_lens():
    """The fault: the first view's coefficients for all."""
    one = lens_camera("fox")
    both = one[torch.tensor([0, 0])]
    both = replace(both, lens=torch.cat([one.lens, torch.tensor([STRONG], dtype=torch.float64)]))
    alone = replace(one, lens=both.lens[1:])
    assert both[0].lens_model == "radial_tangential"
    assert torch.equal(rays_of(both, 0).directions, rays_of(one).directions)
    assert torch.equal(rays_of(both, 1).directions, rays_of(alone).directions)
    point = torch.tensor([[0.3, 0.2, -0.1]], dtype=torch.float64)
    assert torch.equal(project(both, 1, point), project(alone, 0, point))


@pytest.mark.parametrize("model", ["pinhole", "radial_tangential", "fisheye"])
def test_gradients_are_those_of_differences(model):
    directions = torch.cat([places(6), 0.5 + places(6)[:, :1].abs()], dim=-1).requires_grad_()
    lens = torch.tensor([0.1, -0.05, 0.02, -0.01, 0.01, -0.02], dtype=torch.float64, requires_grad=model != "pinhole")
    assert torch.autograd.gradcheck(lambda d, k: project_plane(d, k, model), (directions, lens))
    plane = (0.5 * places(6)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, k: unproject(p, k, model), (plane, lens))


@pytest.mark.parametrize("model", ["radial_tangential", "fisheye"])
def test_on_the_axis_values_and_gradients_are_finite(model):
    lens = torch.tensor([*FOX[:4], 0.0, 0.0], requires_grad=True)
    for fn, at in ((project_plane, [0.0, 0.0, 2.0]), (unproject, [0.0, 0.0])):
        at = torch.tensor(at, requires_grad=True)
        out = fn(at, lens, model)
        assert torch.equal(out, torch.tensor([0.0, 0.0, 1.0][: len(out)]))
        gradients = torch.autograd.grad(out.sum(), [at, lens])
        assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
        assert float(gradients[0][0]) == (0.5 if fn is project_plane else 1.0)


@pytest.mark.parametrize("model", ["radial_tangential", "fisheye"])
def test_stretches_are_the_singular_values_of_the_projection(model):
    lens = torch.tensor([0.1, -0.05, 0.02, -0.01, 0.01, -0.02], dtype=torch.float64)
    lens = lens if model == "radial_tangential" else lens * torch.tensor([1, 1, 1, 1, 0, 0])
    directions = unproject(places(20), lens, model)
    for direction, found in zip(directions, stretches(directions, lens, model), strict=True):
        if model == "fisheye":  # against an angle: steps of unit length across the direction
            unit = direction / direction.norm()
            across = torch.linalg.svd(unit[None]).Vh[1:].T
        else:  # against the pinhole's plane
            unit, across = direction, torch.eye(3, 2, dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(lambda d: project_plane(d, lens, model), unit) @ across
        torch.testing.assert_close(torch.linalg.svdvals(jacobian).flip(0), found)


@pytest.mark.parametrize("model", ["radial_tangential", "fisheye"])
def test_nothing_depends_on_values(model):
    """On the meta device there are none: a branch or a size that asks for one fails, as it would wait on a GPU."""
    plane, lens = torch.empty(5, 2, device="meta"), torch.empty(5, 6, device="meta")
    assert project_plane(unproject(plane, lens, model), lens, model).shape == (5, 2)


NONE = [0.0] * 6


def cameras_with(*lenses, model="radial_tangential", focal=60.0):
    c2w = torch.eye(4)[:3].repeat(len(lenses), 1, 1)
    return replace(pinhole_cameras(c2w, focal, 100, 80), lens=torch.tensor(lenses), lens_model=model)


def refused(cameras, *parts):
    names = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    message = next(iter(lens_faults(cameras, names[: len(cameras.lens)]).values()))
    for part in parts:
        assert part in message, message
    assert "\n" not in message


def test_lenses_that_are_used_pass():
    assert not lens_faults(cameras_with([0.0578421, -0.0805099, 0.0, 0.0, -0.00098, 0.00016], NONE), ["a", "b"])
    assert not lens_faults(cameras_with([-0.3, 0.1, 0.0, 0.0, 0.0, 0.0]), ["a"])
    assert not lens_faults(
        cameras_with([0.0348, 0.0040, -0.0029, 0.0006, 0.0, 0.0], model="fisheye", focal=40.0), ["a"]
    )
    assert not lens_faults(cameras_with(NONE, model="pinhole"), ["a"])


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
    assert not lens_faults(cameras_with([k1, 0, 0, 0, 0, 0], focal=math.hypot(50, 40) / (0.98 * last)), ["a"])
    refused(cameras_with([k1, 0, 0, 0, 0, 0], focal=math.hypot(50, 40) / (1.05 * last)), "a.jpg", "pixel (")


def test_an_exact_inverse_beyond_a_fold_is_refused():
    """A crop far from the axis: its places come back exactly, from a branch that no real lens has."""
    rises_falls_rises = cameras_with([-1.2, 0.5, 0.0, 0.0, 0.0, 0.0], focal=100.0)
    crop = replace(rises_falls_rises, center=torch.tensor([[-150.0, 40.0]]))
    refused(crop, "folds back before it reaches pixel (")


def test_a_fisheye_that_would_see_more_than_everything():
    """The corners are 64 pixels from the axis: 3.05 radians at a focal length of 21 pixels, but 3.37 at 19."""
    assert not lens_faults(cameras_with(NONE, model="fisheye", focal=21.0), ["a"])
    refused(cameras_with(NONE, model="fisheye", focal=19.0), "a.jpg", "pixel (", "model fisheye")


@pytest.mark.parametrize(
    ("lens", "model", "parts"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.01, 0.0], "fisheye", ("p1, p2, which the fisheye model", "p1=0.01")),
        ([math.nan, 0.0, 0.0, 0.0, 0.0, 0.0], "radial_tangential", ("has coefficients that are not finite",)),
        # The usual mistake with units: divided by nothing.
        ([-40.0, 12.0, 0.0, 0.0, 0.0, 0.0], "radial_tangential", ("for lengths in focal lengths, not in pixels",)),
    ],
)
def test_coefficients_that_no_lens_has_are_refused(lens, model, parts):
    refused(cameras_with(lens, model=model), *parts)
