from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene, some_rays, tiny_field

from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.near_gradients import soften_near_gradients
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput


@pytest.mark.parametrize(("distance", "share"), [(0.0, 0.0), (0.5, 0.0625), (1.0, 0.25), (2.0, 1.0), (9.0, 1.0)])
def test_values_stay_and_gradients_fall_with_the_square_of_the_distance(distance, share):
    density, rgb = torch.tensor([[3.0]], requires_grad=True), torch.full((1, 1, 3), 0.4, requires_grad=True)
    seen = soften_near_gradients(FieldOutput(density, rgb), torch.tensor([[distance]]), whole_from=2.0)
    assert torch.equal(seen.density, density)
    assert torch.equal(seen.rgb, rgb)
    (2.0 * seen.density.sum() + 3.0 * seen.rgb.sum()).backward()
    assert density.grad.tolist() == [[2.0 * share]]
    torch.testing.assert_close(rgb.grad, torch.full((1, 1, 3), 3.0 * share))


@pytest.mark.parametrize("training", [True, False])
def test_a_level_softens_them_in_training_alone(training):
    field, rays = tiny_field(), some_rays(6)
    random = batch_random(0, 6) if training else None

    def gradient(whole_from):
        field.zero_grad()
        DenseLevel(StratifiedSampler(8), field, whole_from)(rays, None, [], random).rgb.sum().backward()
        return torch.cat([p.grad.flatten() for p in field.parameters()])

    whole = gradient(0.0)
    assert torch.equal(gradient(1e-6), whole)
    assert torch.equal(gradient(100.0), whole) != training


@pytest.mark.parametrize("ndc", [False, True])
def test_in_normalised_device_coordinates_no_distance_is_one(ndc):
    scene = ball_scene()
    scale = torch.ones(len(scene.cameras.c2w), 2) if ndc else None
    level = DenseLevel(StratifiedSampler(8), tiny_field(), 2.0)
    level.fit_to(replace(scene, cameras=replace(scene.cameras, ndc=scale)))
    assert level.gradient_scaling_distance == (0.0 if ndc else 2.0)
