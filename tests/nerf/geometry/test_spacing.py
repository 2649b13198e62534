import pytest
import torch

from nerf_lightning.nerf.geometry.contraction import contract, from_normalized_distance, normalized_distance


def test_the_two_are_inverse():
    distances = torch.cat([torch.linspace(0, 3, 100), torch.tensor([10.0, 100.0, 1e4])]).double()
    assert torch.allclose(from_normalized_distance(normalized_distance(distances)), distances, rtol=1e-9)
    shares = torch.linspace(0, 0.9999, 100).double()
    assert torch.allclose(normalized_distance(from_normalized_distance(shares)), shares, atol=1e-12)


def test_it_grows_from_nothing_to_one_and_ends_finite():
    distances = torch.logspace(-3, 6, 1000).double()
    assert bool((normalized_distance(distances).diff() > 0).all())
    assert float(normalized_distance(torch.tensor(0.0))) == 0.0
    assert bool(torch.isfinite(from_normalized_distance(torch.tensor([1.0, 0.5, 0.0]))).all())


def test_both_sides_meet_at_distance_one_with_one_slope():
    at = torch.tensor([1.0 - 1e-6, 1.0, 1.0 + 1e-6]).double()
    steps = normalized_distance(at).diff() / at.diff()
    assert steps.tolist() == pytest.approx([0.5, 0.5], rel=1e-5)


def test_from_the_middle_even_steps_are_even_steps_of_the_contraction():
    distances = from_normalized_distance(torch.linspace(0.0, 0.999, 200, dtype=torch.float64))
    along = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    steps = contract(distances[:, None] * along).norm(dim=-1).diff()
    assert torch.allclose(steps, steps.mean().expand_as(steps), rtol=1e-9)
