from dataclasses import replace

import pytest
import torch
from support.scenes import some_rays

from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.losses.proposal import ProposalLoss, distortion_loss, interlevel_loss, outer_weights
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.types.rays import PixelIndex, RaySamples, Target
from nerf_lightning.nerf.types.renderings import FieldOutput


def rendering(edges, density, requires_grad=False):
    rays = some_rays(edges.shape[0])
    density = density.clone().requires_grad_(requires_grad)
    seen = composite(FieldOutput(density, torch.rand(*density.shape, 3)), RaySamples(edges), rays, torch.ones(3))
    return seen, density


def random_edges(rays, count):
    return (2.0 + 4.0 * torch.rand(rays, count)).sort(dim=-1).values


def test_a_proposal_that_is_the_truth_costs_nothing_and_one_that_misses_it_does():
    edges = torch.linspace(2.0, 6.0, 17).expand(5, -1)
    density = torch.rand(5, 16)
    last, _ = rendering(edges, density)
    same, _ = rendering(edges, density)
    missing, _ = rendering(edges, torch.zeros(5, 16))
    assert float(interlevel_loss(last, same).mean()) == pytest.approx(0.0, abs=1e-9)
    assert float(interlevel_loss(last, missing).mean()) > 0.1


def test_only_the_proposal_learns_from_the_interlevel_loss():
    last, last_density = rendering(random_edges(4, 12), torch.rand(4, 11), requires_grad=True)
    proposal, density = rendering(random_edges(4, 9), 0.1 * torch.rand(4, 8), requires_grad=True)
    interlevel_loss(last, proposal).mean().backward()
    assert last_density.grad is None
    assert float(density.grad.abs().sum()) > 0


def test_outer_weights_are_those_of_all_intervals_that_touch():
    t, u, v = random_edges(20, 7), random_edges(20, 12), torch.rand(20, 11)
    found = outer_weights(t, u, v)
    for ray in range(20):
        for i in range(6):
            a, b = t[ray, i], t[ray, i + 1]
            touching = sum(float(v[ray, j]) for j in range(11) if u[ray, j] < b and u[ray, j + 1] > a)
            assert float(found[ray, i]) == pytest.approx(touching, abs=1e-5)


def test_distortion_is_the_double_sum():
    seen, _ = rendering(random_edges(6, 9), torch.rand(6, 8))
    edges, w = seen.samples.edges, seen.weights
    span = edges[:, -1:] - edges[:, :1]
    m, d = (seen.samples.midpoints - edges[:, :1]) / span, seen.samples.deltas / span
    pairs = (w[:, :, None] * w[:, None, :] * (m[:, :, None] - m[:, None, :]).abs()).sum((1, 2))
    expected = pairs + (w.square() * d).sum(1) / 3
    torch.testing.assert_close(distortion_loss(seen), expected)


def as_target(rgb, weight=None):
    places = torch.arange(len(rgb))
    weight = torch.ones(len(rgb)) if weight is None else weight
    return Target(rgb, weight, PixelIndex(places, places, places))


def test_each_level_has_its_own_terms():
    proposal, _ = rendering(random_edges(4, 9), torch.rand(4, 8))
    last, _ = rendering(random_edges(4, 12), torch.rand(4, 11))
    target = torch.rand(4, 3)
    terms = ProposalLoss(interlevel=2.0, distortion=0.5)([proposal, last], as_target(target))
    none = torch.tensor(0.0)
    expected = {
        "interlevel": [2.0 * interlevel_loss(last, proposal).mean(), none],
        "color": [none, (last.rgb - target).square().mean()],
        "distortion": [none, 0.5 * distortion_loss(last).mean()],
    }
    torch.testing.assert_close(terms, {name: torch.stack(values) for name, values in expected.items()})


def test_a_ray_without_weight_teaches_no_level_anything():
    proposal, density = rendering(random_edges(4, 9), 0.1 * torch.rand(4, 8), requires_grad=True)
    last, last_density = rendering(random_edges(4, 12), torch.rand(4, 11), requires_grad=True)
    weight = torch.tensor([2.0, 0.0, 2.0, 0.0])
    torch.cat(list(ProposalLoss()([proposal, last], as_target(torch.rand(4, 3), weight)).values())).sum().backward()
    for gradient in (density.grad, last_density.grad):
        assert (gradient.abs().sum(dim=1) > 0).tolist() == [True, False, True, False]


def test_without_an_end_distortion_is_measured_in_the_spacing():
    seen, _ = rendering(20.0 * random_edges(6, 9), torch.rand(6, 8))
    contracted_spacing = replace(seen, samples=RaySamples(seen.samples.edges, contracted_spacing=True))
    in_spacing = replace(seen, samples=RaySamples(normalized_distance(seen.samples.edges)))
    torch.testing.assert_close(distortion_loss(contracted_spacing), distortion_loss(in_spacing))
    assert not torch.allclose(distortion_loss(contracted_spacing), distortion_loss(seen), rtol=0.05)
