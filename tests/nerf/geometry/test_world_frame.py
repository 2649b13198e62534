"""The working frame: where up is, where the middle is, and the similarity that leads back to the user."""

import pytest
import torch
from torch.nn import functional

from nerf_lightning.nerf.geometry.poses import is_rigid, look_at
from nerf_lightning.nerf.geometry.world_frame import (
    average_pose,
    focus_point,
    points_from_user,
    poses_from_user,
    similarity,
    unit_of,
    up_direction,
    upright_rotation,
)

Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
TARGET = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)


def rotation(seed):
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    q = q * r.diagonal().sign()
    return q * torch.linalg.det(q)


def around(count=20, height=1.5, part=1.0):
    """Cameras on part of a circle that look at the target."""
    angle = torch.linspace(0, 2 * torch.pi * part, count + 1, dtype=torch.float64)[:-1]
    eyes = TARGET + torch.stack([4 * angle.cos(), 4 * angle.sin(), height + 0.2 * (5 * angle).sin()], dim=-1)
    return look_at(eyes, TARGET.expand_as(eyes), Z)


def rolled(c2w, degrees):
    """Turn each camera around its own axis, as a photographer turns it."""
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    return torch.cat([c2w[:, :, :3] @ turn, c2w[:, :, 3:]], dim=-1)


def forward(count=9):
    """A plane of cameras that look along +y, a little toward each other."""
    place = torch.arange(count, dtype=torch.float64)
    eyes = torch.stack([0.3 * (place % 3 - 1), 0 * place, 0.3 * (place // 3 - 1)], dim=-1)
    return look_at(eyes, 0.3 * eyes + torch.tensor([0.0, 6.0, 0.0], dtype=torch.float64), Z)


def moved(c2w, turn, unit, shift):
    return torch.cat([turn @ c2w[:, :, :3], (unit * c2w[:, :, 3] @ turn.T + shift)[:, :, None]], dim=-1)


def test_the_focus_is_what_all_cameras_look_at_and_finite_for_parallel_ones():
    assert torch.allclose(focus_point(around()), TARGET, atol=1e-4)
    c2w = torch.eye(4, dtype=torch.float64)[:3].repeat(4, 1, 1)
    c2w[:, 0, 3] = torch.arange(4)
    assert torch.allclose(focus_point(c2w)[:2], torch.tensor([1.5, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("height", [-0.5, 0.0, 1.5, 3.0])
@pytest.mark.parametrize("part", [1.0, 0.5, 0.25])
def test_up_of_upright_cameras(height, part):
    assert torch.allclose(up_direction(around(height=height, part=part)), Z, atol=1e-6)


def test_up_of_photographs_that_lie_on_their_side_and_of_a_forward_facing_capture_is_the_photographers():
    for degrees in (90.0, -90.0):
        assert torch.allclose(up_direction(rolled(around(height=1.5), degrees)), Z, atol=1e-6)
    assert float(up_direction(forward()) @ Z) > 0.999
    sideways = up_direction(rolled(forward(), 90.0))
    assert abs(float(sideways @ Z)) < 0.01  # nothing tells a sideways wall from an upright one


def test_a_hand_that_shakes_hardly_tilts_up():
    poses = around()
    shaken = torch.cat([rolled(poses[i : i + 1], 5.0 * (-1) ** i) for i in range(20)])
    assert float(up_direction(shaken) @ Z) > 0.999


@pytest.mark.parametrize("c2w", [around(), rolled(around(), 90.0), forward()], ids=["upright", "sideways", "forward"])
@pytest.mark.parametrize("seed", [1, 2])
def test_up_and_focus_turn_with_the_capture(c2w, seed):
    turn, unit, shift = rotation(seed), 7.3, torch.tensor([100.0, -50.0, 3.0], dtype=torch.float64)
    other = moved(c2w, turn, unit, shift)
    assert torch.allclose(up_direction(other), turn @ up_direction(c2w), atol=1e-6)
    assert torch.allclose(focus_point(other), unit * turn @ focus_point(c2w) + shift, atol=1e-3)


NEARLY_DOWN = functional.normalize(torch.tensor([1e-7, 0, -1.0], dtype=torch.float64), dim=0)


@pytest.mark.parametrize("up", [Z, -Z, NEARLY_DOWN, *(rotation(seed)[0] for seed in range(3))])
def test_the_upright_rotation_takes_up_to_z_and_turns_no_more(up):
    found = upright_rotation(up)
    assert torch.allclose(found @ up, Z, atol=1e-6)
    assert torch.allclose(found @ found.T, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert float(torch.linalg.det(found)) == pytest.approx(1.0)
    assert (float(found.trace()) - 1) / 2 == pytest.approx(float(up[2]), abs=1e-9)


@pytest.mark.parametrize("seed", [1, 2])
def test_there_and_back_again(seed):
    to_user = similarity(rotation(seed), torch.tensor([5.0, 6.0, -7.0], dtype=torch.float64), 0.37)
    assert unit_of(to_user) == pytest.approx(0.37)
    c2w = around()
    here = poses_from_user(c2w, to_user)
    assert bool(is_rigid(here).all())
    back = moved(here, to_user[:3, :3] / 0.37, 0.37, to_user[:3, 3])
    assert torch.allclose(back, c2w, atol=1e-9)
    points = points_from_user(c2w[:, :, 3], to_user)
    assert torch.allclose(points @ to_user[:3, :3].T + to_user[:3, 3], c2w[:, :, 3], atol=1e-9)


def test_the_average_pose_is_rigid_and_in_the_middle():
    mean = average_pose(forward())
    assert bool(is_rigid(mean))
    assert torch.allclose(mean[:, 3], torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(mean[:, 2], torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), atol=1e-3)
    assert torch.allclose(average_pose(forward()[:1]), forward()[0], atol=1e-9)
