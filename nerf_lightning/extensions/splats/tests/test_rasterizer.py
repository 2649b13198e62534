"""The rasterizer: closed forms, invariance, and the kernels against the reference, forward and backward."""

import math
from dataclasses import replace

import pytest
import torch
from support.some_splats import camera, some
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.gaussians import DILATION, Gaussians, Pinhole, dc_of_color, project
from nerf_lightning.extensions.splats.rasterizer import rasterize
from nerf_lightning.extensions.splats.reference import rasterize as reference
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion as rotations

BLACK, WHITE = torch.zeros(3), torch.ones(3)
RED, GREEN = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])


def splat(mean=(0.0, 0.0, 2.0), scale=0.1, opacity=0.5, color=RED):
    logit = torch.tensor([math.log(opacity / (1 - opacity))])
    log_scales = torch.as_tensor(scale).log().expand(1, 3).clone()
    return Gaussians(
        torch.tensor([mean]),
        log_scales,
        torch.tensor([[1.0, 0, 0, 0]]),
        logit,
        dc_of_color(color),
        torch.zeros(1, 0, 3),
    )


def joined(*parts):
    return Gaussians(*(torch.cat(each) for each in zip(*(part.tensors().values() for part in parts), strict=True)))


def test_one_splat_on_the_axis():
    """Its standard deviation is 30 * 0.1 / 2 = 1.5 pixels; the middle pixel's center is where its mean is."""
    variance = 1.5**2 + DILATION
    for draw in (rasterize, reference):
        picture = draw(splat(), camera(), BLACK)
        torch.testing.assert_close(picture[10, 16], torch.tensor([0.5, 0.0, 0.0]), atol=1e-5, rtol=0)
        expected = 0.5 * math.exp(-0.5 * (2**2 + 1) / variance)
        assert float(picture[11, 18, 0]) == pytest.approx(expected, abs=1e-5)
        assert float(picture[0, 0].sum()) == 0.0


def test_the_nearer_of_two_covers_the_other_and_both_the_background():
    two = joined(splat((0.0, 0.0, 3.0), opacity=0.8, color=GREEN), splat(opacity=0.6))
    for draw in (rasterize, reference):
        picture = draw(two, camera(), WHITE)
        expected = torch.tensor([0.6 + 0.4 * 0.2, 0.4 * 0.8 + 0.4 * 0.2, 0.4 * 0.2])
        torch.testing.assert_close(picture[10, 16], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("hidden", [(0.0, 0.0, -2.0), (0.0, 0.0, 0.05), (50.0, 0.0, 2.0)])
def test_what_is_behind_the_camera_too_near_or_outside_is_not_drawn(hidden):
    assert torch.equal(rasterize(splat(hidden), camera(), WHITE), torch.ones(21, 33, 3))


def test_a_needle_and_a_point_are_as_wide_as_the_dilation():
    thin = splat(scale=[0.5, 1e-12, 1e-12])
    assert project(thin, camera()).conics[0, 2].item() == pytest.approx(1 / DILATION, rel=1e-3)
    for tiny in (thin, splat(scale=0.0)):
        torch.testing.assert_close(
            rasterize(tiny, camera(), BLACK), reference(tiny, camera(), BLACK), atol=1e-5, rtol=0
        )


@pytest.mark.parametrize(
    "broken", [{"means": math.nan}, {"log_scales": 1e4}, {"opacity_logits": math.nan}, {"sh_dc": math.inf}]
)
def test_a_number_that_is_not_finite_hides_its_splat_and_no_other(broken):
    ((name, value),) = broken.items()
    bad = splat(opacity=0.9, color=GREEN)
    getattr(bad, name)[...] = value
    both = joined(bad, splat()).map(lambda each: each.requires_grad_())
    picture = rasterize(both, camera(), BLACK)
    assert torch.equal(picture, rasterize(splat(), camera(), BLACK))
    picture.sum().backward()
    assert all(each.grad.isfinite().all() for each in both.tensors().values())


def test_no_splats_show_the_background():
    nothing = some().map(lambda each: each[:0].requires_grad_())
    picture = rasterize(nothing, camera(), WHITE)
    assert torch.equal(picture, torch.ones(21, 33, 3))
    picture.sum().backward()


def test_turning_the_world_and_the_camera_changes_nothing():
    turn, shift = rotations(torch.tensor([0.3, -0.7, 0.2, 0.6])), torch.tensor([3.0, -1.0, 2.0])
    first = some(degree=0)
    axes = rotations(first.quaternions)
    turned = replace(first, means=first.means @ turn.mT + shift, quaternions=quaternions_of(turn @ axes))
    elsewhere = replace(camera(), rotation=turn.mT, eye=shift)
    expected = rasterize(first, camera(), WHITE)
    torch.testing.assert_close(rasterize(turned, elsewhere, WHITE), expected, atol=2e-5, rtol=0)


def quaternions_of(matrices):
    """By the eigenvector of Bar-Itzhack (2000), unlike `files.quaternions`."""
    m = matrices.double()
    k = torch.zeros(*m.shape[:-2], 4, 4, dtype=torch.float64)
    k[..., 0, 0] = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    skew = torch.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], dim=-1)
    k[..., 0, 1:], k[..., 1:, 0] = skew, skew
    k[..., 1:, 1:] = m + m.mT - k[..., 0, 0, None, None] * torch.eye(3).double()
    return torch.linalg.eigh(k).eigenvectors[..., -1].float()


@pytest.mark.parametrize(
    ("count", "size", "degree"), [(40, (33, 21), 3), (1, (16, 16), 0), (300, (50, 17), 2), (60, (5, 40), 1)]
)
def test_the_kernels_equal_the_reference_and_its_gradients(count, size, degree):
    exact = some(count, degree, torch.float64).map(lambda each: each.requires_grad_())
    fast = exact.map(lambda each: each.detach().float().requires_grad_())
    turn = rotations(torch.tensor([1.0, 0.02, -0.1, 0.05]))
    where = replace(camera(*size, focal=0.9 * max(size)), rotation=turn, eye=torch.tensor([0.1, 0.0, 0.2]))
    exactly = replace(where, rotation=turn.double(), eye=where.eye.double())
    expected, on_screen = reference(exact, exactly, WHITE.double()), torch.zeros(count, 2, requires_grad=True)
    found = rasterize(fast, where, WHITE, on_screen)
    torch.testing.assert_close(found.double(), expected, atol=5e-5, rtol=0)
    weight = torch.rand(found.shape, generator=torch.Generator().manual_seed(1)) - 0.3
    (found * weight).sum().backward()
    (expected * weight).sum().backward()
    for name, each in exact.tensors().items():
        given, right = fast.tensors()[name].grad.double(), each.grad
        if right.numel():
            torch.testing.assert_close(given, right, atol=2e-4 * float(right.abs().max()) + 1e-6, rtol=1e-3, msg=name)
    assert on_screen.grad.abs().max() > 0


def test_the_gradients_of_the_reference_are_differences():
    """Autograd of the reference itself, on smooth pictures: no splat reaches its cut."""
    few = some(3, 1, torch.float64)
    few.means[:] = torch.tensor([[0.0, 0.1, 2.0], [0.2, 0.0, 3.0], [-0.2, -0.1, 4.0]])
    few.log_scales[:] = torch.tensor([0.2, 0.0, -0.2])
    where = replace(camera(6, 5, 5.0), rotation=torch.eye(3).double(), eye=torch.zeros(3).double())
    weight = torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(2)).double()

    def value(*rest):  # the means also turn the colors, which has no gradient
        seen = reference(Gaussians(few.means, *rest), where, WHITE.double())
        return (seen * weight).sum()

    rest = list(few.map(lambda each: each.requires_grad_()).tensors().values())[1:]
    assert torch.autograd.gradcheck(value, rest, eps=1e-6, atol=1e-6)


def test_opaque_splats_end_the_light_and_equal_input_gives_equal_bits():
    walls = joined(*(splat((0.0, 0.0, 2.0 + 0.1 * k), 5.0, 0.999, RED if k < 8 else GREEN) for k in range(60)))
    pictures = [rasterize(walls, camera(64, 40), WHITE) for _ in range(2)]
    assert torch.equal(*pictures)
    torch.testing.assert_close(pictures[0], RED.expand(40, 64, 3), atol=2e-4, rtol=0)
    torch.testing.assert_close(pictures[0], reference(walls, camera(64, 40), WHITE), atol=1e-5, rtol=0)


def test_a_camera_of_the_scene_looks_where_its_rays_go():
    from support.scenes import ball_scene

    from nerf_lightning.nerf.geometry.cameras import project as seen_at

    scene = ball_scene(num_views=4, size=24)
    points = 0.3 * normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    some_splats = Gaussians(
        points, -3 * torch.ones(20, 3), torch.ones(20, 4), torch.zeros(20), torch.zeros(20, 3), torch.zeros(20, 0, 3)
    )
    for view in range(4):
        found = project(some_splats, Pinhole.of(scene.cameras, view, 0.1)).means
        torch.testing.assert_close(found, seen_at(scene.cameras, view, points), atol=1e-3, rtol=0)
