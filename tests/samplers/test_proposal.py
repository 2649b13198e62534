import pytest
import torch
from scenes import some_rays

from nerf_lightning.randomness import batch_random
from nerf_lightning.rendering.quadrature import composite
from nerf_lightning.samplers.proposal import ProposalSampler
from nerf_lightning.samplers.stratified import StratifiedSampler
from nerf_lightning.types import FieldOutput


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
