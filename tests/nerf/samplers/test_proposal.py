from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays

from nerf_lightning.nerf.geometry.contraction import normalized_distance
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.samplers.proposal import ProposalSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput


def proposal(rays, place=4.0):
    samples = StratifiedSampler(64)(rays, [], None)
    density = 200.0 * ((samples.midpoints - place).abs() < 0.1).float()
    return composite(FieldOutput(density, torch.zeros(*density.shape, 3)), samples, rays, None)


@pytest.mark.parametrize("random", [None, batch_random(4, 30)])
def test_it_samples_where_the_proposal_saw_something_and_a_little_elsewhere(random):
    rays = some_rays(30)
    samples = ProposalSampler(32)(rays, [proposal(rays)], random)
    assert samples.edges.shape == (30, 33)
    assert bool((samples.deltas >= 0).all())
    near_surface = ((samples.edges - 4.0).abs() < 0.2).float().mean()
    assert 0.4 < float(near_surface) < 1.0
    assert bool(((samples.edges >= 2.0) & (samples.edges <= 6.0)).all())


def test_positions_carry_no_gradient():
    rays = some_rays(3)
    seen = proposal(rays)
    seen = type(seen)(**{**vars(seen), "weights": seen.weights.requires_grad_()})
    assert not ProposalSampler(8)(rays, [seen], None).edges.requires_grad


def test_it_needs_a_level_before_it():
    with pytest.raises(ValueError, match="needs a level before"):
        ProposalSampler(8).num_samples_after(0)


def test_without_an_end_it_spreads_its_samples_in_disparity():
    rays = replace(some_rays(30), near=torch.full((30,), 0.1), far=torch.full((30,), 100.0))
    stratified = StratifiedSampler(64)
    stratified.fit_to(replace(ball_scene(), space="contracted"))
    samples = stratified(rays, [], None)
    seen = composite(FieldOutput(torch.zeros(30, 64), torch.zeros(30, 64, 3)), samples, rays, torch.ones(3))
    found = ProposalSampler(32)(rays, [seen], None)
    assert found.contracted_spacing
    # A proposal that saw nothing asks for even steps of the spacing, of which half lie within distance 1.
    steps = normalized_distance(found.edges).diff(dim=-1)
    torch.testing.assert_close(steps, steps.mean().expand_as(steps), rtol=0.02, atol=0)
    assert 0.4 < float((found.edges < 1.0).float().mean()) < 0.5
    assert bool(((found.edges >= 0.1) & (found.edges <= 100.01)).all())
