"""Depth as supervision: closed forms, both layouts, normalized device coordinates, outliers, fading."""

import math
from dataclasses import replace

import pytest
import torch
from support.scenes import some_rays

from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.geometry.ndc import ndc_rays, share_at_distance, world_distance
from nerf_lightning.nerf.losses.depth import DepthLoss, distance_error
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.proposal import ProposalLoss, distortion_loss, interlevel_loss, outer_weights
from nerf_lightning.nerf.losses.robust import RobustLoss
from nerf_lightning.nerf.losses.weighted_sum import WeightedSum
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.quadrature import composite, composite_ragged
from nerf_lightning.nerf.types.rays import PixelIndex, RaggedSamples, RayBundle, RaySamples, Target
from nerf_lightning.nerf.types.renderings import FieldOutput

NEAR, FAR, SAMPLES = 2.0, 6.0, 400


def seen(density, edges=None):
    rays = some_rays(len(density))
    edges = torch.linspace(NEAR, FAR, density.shape[1] + 1).expand(len(density), -1) if edges is None else edges
    return composite(FieldOutput(density, torch.rand(*density.shape, 3)), RaySamples(edges), rays, torch.ones(3))


def wall_at(distance):
    """What rays see of an opaque wall; one ray for each distance."""
    edges = torch.linspace(NEAR, FAR, SAMPLES + 1)
    return seen(1e4 * (edges[:-1] >= torch.tensor(distance)[:, None]).float())


def target_of(distance, certainty=None):
    count = len(distance)
    pixels = PixelIndex(*(torch.zeros(count, dtype=torch.int64) for _ in range(3)))
    certain = torch.ones(count) if certainty is None else torch.tensor(certainty)
    return Target(torch.rand(count, 3), torch.ones(count), pixels, torch.tensor(distance), certain)


def depth_of(loss, rendering, target):
    return float(loss([rendering], target)["depth"].sum())


def test_a_wall_where_it_should_be_costs_nothing_and_elsewhere_the_logarithm_of_the_ratio():
    rendering, known = wall_at([3.0, 3.0, 3.0]), torch.tensor([3.0, 4.5, 2.2])
    expected = [0.0, math.log(1.5), math.log(3.0 / 2.2)]
    assert distance_error(rendering, known, None).tolist() == pytest.approx(expected, abs=0.004)


def test_an_empty_ray_costs_one_and_no_mistake_costs_more():
    loss = DepthLoss(every=2)
    assert depth_of(loss, seen(torch.zeros(1, 8)), target_of([3.0])) == pytest.approx(2.0)
    assert depth_of(loss, wall_at([2.5]), target_of([90.0])) == pytest.approx(2.0, abs=1e-4)


def test_only_known_distances_count_and_those_by_their_certainty():
    loss, rendering = DepthLoss(every=4), wall_at([3.0, 3.0, 3.0, 3.0])
    alone = depth_of(loss, rendering, target_of([4.0, 4.0, 4.0, 4.0], [0.0, 0.0, 0.0, 1.0]))
    assert alone == pytest.approx(math.log(4.0 / 3.0), abs=0.01)
    half = depth_of(loss, rendering, target_of([4.0, 4.0, 4.0, 4.0], [0.0, 0.0, 0.0, 0.5]))
    assert half == pytest.approx(0.5 * alone)
    nothing = Target(torch.rand(4, 3), torch.ones(4), target_of([1.0] * 4).pixels)
    assert loss([rendering, rendering], nothing)["depth"].tolist() == [0.0, 0.0]


def test_ragged_samples_cost_the_same():
    torch.manual_seed(0)
    density, known = torch.rand(5, 7), torch.tensor([2.0, 3.0, 4.0, 5.0, 9.0])
    dense = seen(density)
    starts, ends = dense.samples.starts.flatten(), dense.samples.ends.flatten()
    ray = torch.arange(5).repeat_interleave(7)
    samples = RaggedSamples(ray, starts, ends, 7 * torch.arange(6), torch.tensor(35))
    ragged = composite_ragged(FieldOutput(density.flatten(), torch.rand(35, 3)), samples, some_rays(5), None)
    torch.testing.assert_close(distance_error(ragged, known, None), distance_error(dense, known, None))


def test_in_normalised_device_coordinates_depths_are_compared_as_in_the_world():
    """Along a ray from the origin, depth and distance have one ratio; a wall at 4 is compared with a point at 6."""
    direction = torch.nn.functional.normalize(torch.tensor([[0.2, -0.1, -1.0]]), dim=-1)
    world = RayBundle(torch.zeros(1, 3), direction, torch.zeros(1), torch.ones(1), view_directions=direction)
    bent = ndc_rays(world, torch.tensor([1.5, 1.5]))
    edges = torch.linspace(0.0, 1.0, 2001) * bent.far
    wall = share_at_distance(world, torch.tensor([4.0])) * bent.far
    rendering = seen(1e6 * (edges[None, :-1] >= wall).float(), edges[None])
    assert float(world_distance(world, wall / bent.far)) == pytest.approx(4.0, abs=1e-4)
    point = share_at_distance(world, torch.tensor([6.0])) * bent.far
    found = distance_error(rendering, point, bent.far)
    assert float(found) == pytest.approx(math.log(6.0 / 4.0), abs=0.005)


def test_it_fades_as_the_run_goes_on():
    loss, rendering, target = DepthLoss(fade=0.01), wall_at([3.0]), target_of([4.0])
    first = depth_of(loss, rendering, target)
    loss.on_step(StepContext(progress=0.5, step=50, key=0))
    assert depth_of(loss, rendering, target) == pytest.approx(0.1 * first)


RANDOM = batch_random(5, 400, torch.device("cpu"))


def rays_from_beside(loss, certainty, random=RANDOM, **changed):
    rays = some_rays(400)
    target = replace(target_of([3.0 + 0.01 * number for number in range(400)], [certainty] * 400), **changed)
    return rays, target, *loss.rays_to_render(rays, target, random)


@pytest.mark.parametrize("around", [lambda loss: loss, lambda loss: WeightedSum({"a": loss}), RobustLoss])
def test_some_known_points_are_looked_at_from_beside_their_cameras(around):
    rays, target, moved, there = rays_from_beside(around(DepthLoss(beside=0.25, reach=0.1)), 0.5)
    aside = (moved.origins - rays.origins).norm(dim=-1)
    assert 0.15 < float((aside > 0).float().mean()) < 0.35
    torch.testing.assert_close(aside[aside == 0], (there.distance - target.distance)[aside == 0])
    points, again = (r.origins + t.distance[:, None] * r.directions for r, t in ((rays, target), (moved, there)))
    torch.testing.assert_close(again, points)
    torch.testing.assert_close(moved.directions.norm(dim=-1), torch.ones(400))
    torch.testing.assert_close(((moved.origins - rays.origins) * rays.directions).sum(dim=-1), torch.zeros(400))
    assert 0.1 < float((aside / target.distance)[aside > 0].square().mean().sqrt()) < 0.2  # 0.1 along each of two axes
    assert torch.equal(there.weight == 0, aside > 0)  # the photograph's color is not what is seen from there
    # One in 8 rays of a batch knows a distance, of which a quarter have no color: the mean over the batch is 1.
    torch.testing.assert_close(there.weight[aside == 0], torch.full_like(aside[aside == 0], 1 / (1 - 0.25 / 8)))


def test_from_beside_only_what_is_half_transparent_before_the_point_is_wrong():
    """A wall before the point may be there; fog that lets a third through is pulled at by that third."""
    edges = torch.linspace(NEAR, FAR, SAMPLES + 1)
    fog = (edges[:-1] < 3.0) * math.log(3.0) + 1e4 * (edges[:-1] >= 4.0)
    rendering, target = seen(torch.stack([1e4 * (edges[:-1] >= 3.0), fog]).float()), target_of([4.0, 4.0])
    plain = distance_error(rendering, target.distance, None)
    found = [
        DepthLoss(every=2)([rendering], replace(target, weight=torch.zeros(2), certainty=only))["depth"].sum()
        for only in torch.eye(2)
    ]
    torch.testing.assert_close(torch.stack(found), plain * torch.tensor([0.0, 1 / 3]), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    ("loss", "certainty", "changed"),
    [
        (DepthLoss(), 0.0, {}),
        (DepthLoss(beside=0.0), 1.0, {}),
        (DepthLoss(), 1.0, {"random": None}),
        (DepthLoss(), 1.0, {"infinity": torch.full((400,), 9.0)}),
        (DepthLoss(), 1.0, {"distance": None}),
    ],
)
def test_rays_stay_where_no_point_is_known_and_in_normalised_device_coordinates(loss, certainty, changed):
    rays, target, moved, there = rays_from_beside(loss, certainty, **changed)
    assert torch.equal(moved.origins, rays.origins)
    assert torch.equal(moved.directions, rays.directions)
    assert there.distance is target.distance or torch.equal(there.distance, target.distance)


def test_a_sum_says_how_many_rays_want_a_distance():
    both = WeightedSum({"photo": MeanSquaredError(), "depth": DepthLoss(every=16)}, {"depth": 0.5})
    assert (both.depth_every, both.needs_weights) == (16, True)
    found = both([wall_at([3.0])], target_of([4.0]))
    assert float(found["depth"].sum()) == pytest.approx(0.5 * 16 * math.log(4.0 / 3.0), abs=0.05)
    assert MeanSquaredError().depth_every == 0


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
