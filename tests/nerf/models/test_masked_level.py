import pytest
import torch
from support.scenes import ball_scene, some_rays
from support.static_models import fast_model

from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.randomness import batch_random


def both(**sampler):
    """The same field and grid in both forms, with some cells empty."""
    scene = ball_scene(num_views=12)
    packed, masked = (
        fast_model(level, num_steps=96, **({"opaque_below": 0.0} | sampler)) for level in (RaggedLevel, MaskedLevel)
    )
    packed.fit_to(scene)
    torch.nn.init.normal_(packed.levels["fine"].field.position_encoder.table, std=1.0)
    for step in (4, 8, 12):
        packed.update(step, step)
    grid = packed.levels["fine"].sampler.grid
    grid.occupy(grid.density > grid.density.quantile(0.7))
    state = packed.state_dict()
    masked.fit_to(scene)
    masked.load_state_dict({key: state[key] for key in masked.state_dict()})
    return packed, masked


@pytest.mark.parametrize("background", ["a colour", "none"])
@pytest.mark.parametrize("training", [True, False])
def test_it_renders_what_the_packed_level_renders(background, training):
    packed, masked = both()
    rays, behind = some_rays(60), None if background == "none" else torch.rand(60, 3)
    random = batch_random(3, 60) if training else None
    (expected,), (found,) = packed(rays, behind, random), masked(rays, behind, random)
    assert float(expected.opacity.detach().std()) > 0.05
    for name in ("rgb", "foreground", "opacity", "depth"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-4, atol=2e-5)


def test_it_learns_what_the_packed_level_learns():
    """The same gradients."""
    packed, masked = both()
    rays, random = some_rays(60), batch_random(3, 60)
    for model in (packed, masked):
        model(rays, torch.ones(60, 3), random)[0].rgb.square().mean().backward()
    for (name, expected), found in zip(packed.named_parameters(), masked.parameters(), strict=True):
        torch.testing.assert_close(found.grad, expected.grad, rtol=1e-3, atol=1e-6, msg=name)


def test_what_lies_behind_opaque_samples_makes_no_visible_difference():
    packed, masked = both(opaque_below=1e-3)
    rays, white = some_rays(60), torch.ones(60, 3)
    found, expected = (model(rays, white, batch_random(3, 60))[0].rgb for model in (masked, packed))
    assert float((found - expected).detach().abs().max()) < 2e-3


def test_the_grid_keeps_up_with_the_field():
    packed, masked = both()
    for model in (packed, masked):
        for step in (16, 20):
            model.update(step, step)
    pairs = zip(packed.levels["fine"].sampler.buffers(), masked.levels["fine"].sampler.buffers(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert masked.statistics()["train/occupied"] == packed.statistics()["train/occupied"]
