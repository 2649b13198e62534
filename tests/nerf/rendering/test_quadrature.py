import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.scenes import some_rays
from torch.autograd import gradcheck

from nerf_lightning.nerf.rendering.quadrature import closed_weights, composite, weights_from_density
from nerf_lightning.nerf.types.rays import RaySamples
from nerf_lightning.nerf.types.renderings import FieldOutput


def loop_weights(density, deltas):
    weights, light = [], 1.0
    for sigma, delta in zip(density, deltas, strict=True):
        alpha = 1.0 - math.exp(-sigma * delta)
        weights.append(light * alpha)
        light *= 1.0 - alpha
    return weights


def test_weights_equal_a_slow_loop(generator):
    density = 5 * torch.rand(7, 20, generator=generator, dtype=torch.float64)
    deltas = torch.rand(7, 20, generator=generator, dtype=torch.float64)
    expected = [loop_weights(d.tolist(), x.tolist()) for d, x in zip(density, deltas, strict=True)]
    torch.testing.assert_close(weights_from_density(density, deltas), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("bins", [1, 16, 256])
def test_constant_density_has_the_opacity_of_beer_and_lambert(bins):
    sigma, length = 0.7, 3.0
    deltas = torch.full((bins,), length / bins, dtype=torch.float64)
    opacity = weights_from_density(torch.full_like(deltas, sigma), deltas).sum()
    assert abs(float(opacity) - (1 - math.exp(-sigma * length))) < 1e-14


def test_depth_of_constant_density_converges_at_second_order():
    sigma, near, far = 0.9, 2.0, 6.0
    exact = near + (1 - math.exp(-sigma * (far - near))) / sigma
    errors = []
    for bins in (8, 16, 32, 64):
        edges = torch.linspace(near, far, bins + 1, dtype=torch.float64)
        rays = some_rays(1).map(lambda x: x[0])
        output = FieldOutput(torch.full((bins,), sigma, dtype=torch.float64), torch.zeros(bins, 3, dtype=torch.float64))
        rendering = composite(output, RaySamples(edges), rays, torch.zeros(3, dtype=torch.float64))
        errors.append(abs(float(rendering.depth) - exact))
    slopes = [math.log2(a / b) for a, b in pairwise(errors)]
    assert all(abs(slope - 2.0) < 0.1 for slope in slopes)


def test_splitting_an_interval_changes_nothing(generator):
    density = torch.rand(5, 9, generator=generator, dtype=torch.float64)
    deltas = torch.rand(5, 9, generator=generator, dtype=torch.float64)
    whole = weights_from_density(density, deltas)
    halves = weights_from_density(density.repeat_interleave(2, -1), (deltas / 2).repeat_interleave(2, -1))
    torch.testing.assert_close(halves.unflatten(-1, (9, 2)).sum(-1), whole)


def test_an_interval_without_length_weighs_nothing():
    weights = weights_from_density(torch.tensor([3.0, 5.0, 7.0]), torch.tensor([1.0, 0.0, 1.0]))
    assert float(weights[1]) == 0.0


@given(st.lists(st.floats(0, 1e4), min_size=1, max_size=12), st.floats(1e-6, 10))
def test_weights_are_probabilities(densities, delta):
    density = torch.tensor(densities, dtype=torch.float64)
    weights = weights_from_density(density, torch.full_like(density, delta))
    assert bool((weights >= 0).all())
    assert float(weights.sum()) <= 1 + 1e-12


def test_gradients_are_finite_for_extreme_densities_and_lengths():
    exponents = torch.linspace(-100, 100, 41, dtype=torch.float64)
    density = exponents.exp()[:, None, None].expand(-1, 41, 3).clone().requires_grad_()
    deltas = exponents.exp()[None, :, None].expand(41, -1, 3).clone().requires_grad_()
    weights = weights_from_density(density, deltas)
    assert bool(weights.isfinite().all())
    weights.square().sum().backward()
    assert bool(density.grad.isfinite().all())
    assert bool(deltas.grad.isfinite().all())


def test_gradcheck(generator):
    density = torch.rand(3, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    deltas = torch.rand(3, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    assert gradcheck(weights_from_density, (density, deltas))


def test_an_opaque_plane_shows_its_colour_and_depth():
    edges = torch.linspace(2, 6, 401, dtype=torch.float64)
    middle = 0.5 * (edges[1:] + edges[:-1])
    density = torch.where(middle > 3.0, 1e6, 0.0)
    colour = torch.tensor([0.2, 0.4, 0.8], dtype=torch.float64)
    rays = some_rays(1).map(lambda x: x[0])
    rendering = composite(FieldOutput(density, colour.expand(400, 3)), RaySamples(edges), rays, torch.ones_like(colour))
    torch.testing.assert_close(rendering.rgb, colour)
    assert abs(float(rendering.depth) - 3.0) < 0.01


def test_escaping_light_belongs_to_the_background_and_to_far():
    rays = some_rays(1).map(lambda x: x[0])
    edges = torch.linspace(2, 6, 9)
    background = torch.tensor([0.1, 0.5, 0.9])
    empty = FieldOutput(torch.zeros(8), torch.rand(8, 3))
    rendering = composite(empty, RaySamples(edges), rays, background)
    assert torch.equal(rendering.rgb, background)
    assert float(rendering.depth) == 6.0
    assert float(rendering.opacity) == 0.0


def test_a_closed_ray_takes_all_light():
    rays = some_rays(1).map(lambda x: x[0])
    output = FieldOutput(torch.tensor([0.1, 0.2, 0.0]), torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]))
    rendering = composite(output, RaySamples(torch.tensor([2.0, 3.0, 4.0, 6.0])), rays, None)
    assert abs(float(rendering.opacity) - 1.0) < 1e-6
    torch.testing.assert_close(rendering.rgb.sum(), torch.tensor(1.0))
    assert float(closed_weights(torch.zeros(4))[-1]) == 1.0
