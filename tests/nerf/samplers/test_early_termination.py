"""Which samples are visible is the same whether sizes are read on the host (CPU) or arrays have a capacity (CUDA)."""

from contextlib import nullcontext

import pytest
import torch
from support.known_fields import SolidField, ball
from support.scenes import ball_scene, some_rays, tiny_field

from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.samplers.early_termination import visible_samples
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler

RAYS = 40


class RandomDensity(SolidField):
    """Empty, thin or opaque at each point, whatever is around it."""

    def __init__(self, scale):
        super().__init__(ball(9.0))
        self.scale, self.asked = scale, 0

    def density(self, points):
        self.asked += len(points.positions)
        noise = (points.positions @ torch.tensor([127.1, 311.7, 74.7])).sin().mul(43758.5).frac().abs()
        return self.scale * noise.pow(4), torch.stack([noise, points.positions[..., 0]], dim=-1)


def a_level(field, share=0.5, **settings):
    torch.manual_seed(2)
    sampler = OccupancySampler(**{"resolution": 8, "num_steps": 60, "opaque_below": 1e-2} | settings)
    level = RaggedLevel(sampler, field)
    fit_parts(level, ball_scene(num_views=12))
    level.sampler.grid.occupy(torch.rand(8, 8, 8) < share)
    level.returns_weights = True  # so that no kernel takes whole rays
    return level


def with_capacity(level, capacity, monkeypatch):
    def capacity_for(rays):
        return None if capacity is None else min(capacity, 1000 * len(rays.near))

    monkeypatch.setattr(level.sampler, "capacity_for", capacity_for, raising=False)


def found_by(level, capacity, rays, random, monkeypatch):
    with_capacity(level, capacity, monkeypatch)
    return visible_samples(level.sampler, level.field, rays, random)


@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize("num_rays", [0, 1, RAYS])
@pytest.mark.parametrize("scale", [0.0, 10.0, 300.0])
@pytest.mark.parametrize("share", [0.0, 0.5])  # of cells; 0: all rays miss
def test_a_capacity_keeps_the_same_samples(kernels, num_rays, scale, share, monkeypatch):
    monkeypatch.setattr(OccupancySampler, "found_per_visible", 100)  # there is room for all intervals
    level, rays, random = a_level(RandomDensity(scale), share), some_rays(num_rays), batch_random(5, num_rays)
    with without("march.cpu", *(() if kernels else CPU_BACKENDS)):
        expected, features = found_by(level, None, rays, random, monkeypatch)
        count = expected.starts.shape[0]
        assert int(expected.found) == int(expected.bounds[-1]) == count
        assert (count > 0) == (num_rays > 0 and share > 0)
        for capacity in (count + 25, count):
            found, of_found = found_by(level, capacity, rays, random, monkeypatch)
            assert found.starts.shape == of_found.shape[:1] == (capacity if num_rays else 0,)
            assert int(found.found) == count
            assert torch.equal(found.bounds, expected.bounds)
            if count:
                for name in ("ray_index", "starts", "ends"):
                    assert torch.equal(getattr(found, name)[:count], getattr(expected, name))
                assert torch.equal(of_found[:count], features)
            assert not found.deltas[count:].any()
            assert not of_found[count:].any()
            assert bool((found.ray_index[count:] < max(1, num_rays)).all())


def test_what_exceeds_the_capacity_by_one_is_the_last_sample_and_is_counted_as_dropped(monkeypatch):
    level, rays, random = a_level(RandomDensity(10.0)), some_rays(RAYS), batch_random(5, RAYS)
    expected, _ = found_by(level, None, rays, random, monkeypatch)
    count = expected.starts.shape[0]
    found, _ = found_by(level, count - 1, rays, random, monkeypatch)
    assert int(found.found) == count
    assert torch.equal(found.bounds, expected.bounds.clamp(max=count - 1))
    assert torch.equal(found.starts, expected.starts[:-1])
    level(rays, torch.ones(RAYS, 3), [], random)
    assert level.counter.counts.tolist() == [count, RAYS, 1]


def test_intervals_that_nobody_looked_at_count_as_if_they_were_visible(monkeypatch):
    """Otherwise fewer samples were counted a ray, steps had more rays, and even more were dropped."""
    level, rays, random = a_level(RandomDensity(300.0), share=1.0), some_rays(RAYS), batch_random(5, RAYS)
    candidates = int(level.sampler(rays, random).found)
    capacity = candidates // OccupancySampler.found_per_visible - 20
    found, _ = found_by(level, capacity, rays, random, monkeypatch)
    kept, dropped = int(found.bounds[-1]), candidates - OccupancySampler.found_per_visible * capacity
    assert 0 < kept < capacity
    assert int(found.found) == kept + dropped
    assert dropped >= 20 * OccupancySampler.found_per_visible


@pytest.mark.parametrize("capacity", [None, 8000])
def test_visible_samples_are_counted_and_hidden_ones_are_not(capacity, monkeypatch):
    level, rays, random = a_level(SolidField(ball(0.5), inside=200.0), 1.0), some_rays(300), batch_random(5, 300)
    expected, _ = found_by(level, None, rays, random, monkeypatch)
    found_by(level, capacity, rays, random, monkeypatch)
    level(rays, torch.ones(300, 3), [], random)
    assert level.counter.counts.tolist() == [expected.starts.shape[0], 300, 0]
    assert 4 * expected.starts.shape[0] < 5 * int(level.sampler(rays, random).found)


def test_with_all_samples_kept_no_density_is_asked_for(monkeypatch):
    level, rays, random = a_level(RandomDensity(10.0), opaque_below=0.0), some_rays(RAYS), batch_random(5, RAYS)
    found, features = found_by(level, 3000, rays, random, monkeypatch)
    assert features is None
    assert level.field.asked == 0
    assert found.starts.shape == (3000,)


@pytest.mark.parametrize("kernels", [True, False])
def test_gradients_are_those_of_the_samples_without_a_capacity(kernels, monkeypatch):
    level = a_level(tiny_field(density_activation="softplus", density_bias=25.0), 1.0, opaque_below=0.3)
    rays, random, weight = some_rays(RAYS), batch_random(5, RAYS), torch.rand(RAYS, 3)
    gradients, colors = [], []
    with nullcontext() if kernels else without(*CPU_BACKENDS):
        for capacity in (None, 2000):
            with_capacity(level, capacity, monkeypatch)
            seen = level(rays, None, [], random)
            (weight * seen.rgb + seen.depth[:, None]).sum().backward()
            gradients.append([each.grad.clone() for each in level.parameters()])
            colors.append(seen.rgb.detach())
            level.zero_grad()
    counted, _, dropped = level.counter.counts.tolist()
    assert counted < 2 * int(level.sampler(rays, random).found)  # something is hidden
    assert dropped == 0
    torch.testing.assert_close(*colors)
    assert float(gradients[0][0].abs().max()) > 1e-3
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5 * float(other.abs().max()))
