"""Rotations from vectors: the matrix exponential, with gradients that are finite at zero."""

import pytest
import torch

from nerf_lightning.nerf.geometry.poses import is_rigid, rotation_from_vector

ANGLES = [0.0, 1e-12, 1e-6, 1e-3, 0.05, 0.0999, 0.1001, 0.5, 2.0, 3.1, 6.0]


def skew(vector):
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def vectors(angle):
    draw = torch.Generator().manual_seed(3)
    return angle * torch.nn.functional.normalize(torch.randn(20, 3, generator=draw, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize("angle", ANGLES)
def test_it_is_the_matrix_exponential(angle):
    vector = vectors(angle)
    torch.testing.assert_close(rotation_from_vector(vector), torch.matrix_exp(skew(vector)), atol=2e-14, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_its_gradients_are_those_of_the_matrix_exponential(angle):
    weight = torch.randn(20, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    ours, theirs = vectors(angle).requires_grad_(), vectors(angle).requires_grad_()
    (weight * rotation_from_vector(ours)).sum().backward()
    (weight * torch.matrix_exp(skew(theirs))).sum().backward()
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
