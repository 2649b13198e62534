"""The similarity between two sets of poses, and rotations from vectors: the matrix exponential, finite at zero."""

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.geometry.poses import is_rigid, look_at, rotation_from_vector
from nerf_lightning.nerf.geometry.world_frame import similarity


def a_similarity():
    rotation = rotation_from_vector(torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64))
    return similarity(rotation, torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64), 2.5)


def in_a_line(count):
    eyes = torch.tensor([[0.5, 0.0, 0.0]]) * torch.arange(count)[:, None] + torch.tensor([0.0, -4.0, 1.0])
    return look_at(eyes, torch.zeros_like(eyes), torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("poses", [ball_scene().cameras.c2w, in_a_line(4), in_a_line(2)])
def test_poses_that_moved_as_one_are_found_again(poses):
    by = a_similarity()
    moved = carried(poses.double(), by)
    torch.testing.assert_close(similarity_between(poses, moved), by, atol=1e-6, rtol=0)


def test_cameras_in_one_place_turn_and_shift_and_keep_their_size():
    poses = in_a_line(3).double()
    poses[:, :, 3] = torch.tensor([1.0, 2.0, 3.0])
    by = similarity(a_similarity()[:3, :3] / 2.5, torch.tensor([4.0, 0.0, 0.0], dtype=torch.float64), 1.0)
    torch.testing.assert_close(similarity_between(poses, carried(poses, by)), by, atol=1e-9, rtol=0)


ANGLES = [0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.0999, 0.1001, 0.5, 2.0, 3.1, 6.0]


def skew(vector):
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def vectors(angle):
    draw = torch.Generator().manual_seed(3)
    return angle * torch.nn.functional.normalize(torch.randn(20, 3, generator=draw, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize("angle", ANGLES)
def test_it_is_the_matrix_exponential_and_so_are_its_gradients(angle):
    weight = torch.randn(20, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    ours, theirs = vectors(angle).requires_grad_(), vectors(angle).requires_grad_()
    found, expected = rotation_from_vector(ours), torch.matrix_exp(skew(theirs))
    torch.testing.assert_close(found, expected, atol=2e-14, rtol=0)
    for each in (found, expected):
        (weight * each).sum().backward()
    torch.testing.assert_close(ours.grad, theirs.grad, atol=1e-12, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_zero_nothing_turns_and_every_gradient_is_finite(dtype):
    vector = torch.zeros(2, 3, dtype=dtype, requires_grad=True)
    rotation = rotation_from_vector(vector)
    assert torch.equal(rotation, torch.eye(3, dtype=dtype).expand(2, 3, 3))
    rotation[:, 1, 0].sum().backward()
    assert vector.grad.tolist() == [[0.0, 0.0, 1.0]] * 2


def test_in_float32_it_stays_a_rotation():
    draw = torch.Generator().manual_seed(0)
    vector = torch.randn(1000, 3, generator=draw) * torch.logspace(-8, 0.5, 1000)[:, None]
    pose = torch.cat([rotation_from_vector(vector), torch.zeros(1000, 3, 1)], dim=-1)
    assert bool(is_rigid(pose, tolerance=1e-6).all())
