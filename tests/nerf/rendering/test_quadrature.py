import math

import torch
from support.scenes import some_rays

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


def test_gradients_are_finite_for_extreme_densities_and_lengths():
    exponents = torch.linspace(-100, 100, 41, dtype=torch.float64)
    density = exponents.exp()[:, None, None].expand(-1, 41, 3).clone().requires_grad_()
    deltas = exponents.exp()[None, :, None].expand(41, -1, 3).clone().requires_grad_()
    weights = weights_from_density(density, deltas)
    assert bool(weights.isfinite().all())
    weights.square().sum().backward()
    assert bool(density.grad.isfinite().all())
    assert bool(deltas.grad.isfinite().all())


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
