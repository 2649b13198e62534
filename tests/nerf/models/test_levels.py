import pytest
import torch
from support.scenes import some_rays, tiny_field, tiny_model

from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.tiles import tile_rays_for, tiles
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler


def test_levels_run_in_order_and_the_fine_one_sees_the_union():
    model = tiny_model()
    renderings = model(some_rays(5), torch.ones(5, 3), batch_random(0, 5))
    assert model.level_names == ("coarse", "fine")
    assert [r.weights.shape[-1] for r in renderings] == [8, 16]
    assert model.points_per_ray(training=True) == 16
    assert isinstance(model, RadianceModel)


def test_rays_are_rendered_one_by_one():
    model, rays, background = tiny_model(), some_rays(7), torch.rand(7, 3)
    whole = model(rays, background, batch_random(4, 7))[-1]
    one = model(rays[3:4], background[3:4], batch_random(4, 7)[3:4])[-1]
    torch.testing.assert_close(whole.rgb[3:4], one.rgb)


def test_tiles_cover_the_batch_evenly():
    for count, size in [(10, 4), (1024, 85), (5, 9), (7, 7)]:
        parts = list(tiles(count, size))
        assert [i for part in parts for i in range(part.start, part.stop)] == list(range(count))
        sizes = [part.stop - part.start for part in parts]
        assert max(sizes) <= size
        assert max(sizes) - min(sizes) <= 1
    assert tile_rays_for(tiny_model(), 8192) == 512
    assert tile_rays_for(tiny_model(), 1) == 1


@pytest.mark.parametrize(("step", "learns"), [(0, True), (9, True), (10, False), (11, False), (12, True), (13, False)])
def test_after_the_first_steps_proposals_learn_now_and_then(step, learns):
    proposal = ProposalLevel(StratifiedSampler(8), tiny_field(), learn_every=4, learn_always=10)
    rays = some_rays(5)
    proposal.update(step, key=0)
    rendering = proposal(rays, None, [], batch_random(0, 5, rays.near.device))
    assert rendering.weights.requires_grad == learns
    again = ProposalLevel(StratifiedSampler(8), proposal.field)
    assert torch.equal(again(rays, None, [], batch_random(0, 5, rays.near.device)).weights, rendering.weights)
