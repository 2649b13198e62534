import copy

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.static_models import fast_model, static_system
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.callbacks.ray_histograms import PARTS, look_along, write_shares


def a_system(name):
    progress, scene = Progress(), ball_scene(num_views=6)
    model = fast_model(RaggedLevel) if name == "fast_dense" else tiny_model()
    system = static_system(name, scene, progress, 10, model=model)
    return system.step, RayBatches(scene, progress, 0, 64).at(0, 0)


@pytest.mark.parametrize("name", ["nerf", "fast_dense"])
def test_looking_changes_nothing_that_training_reads(name):
    step, batch = a_system(name)
    step.gradients(batch)
    before = copy.deepcopy(step.model.state_dict())
    gradients = [parameter.grad.clone() for parameter in step.model.parameters()]
    generator = torch.get_rng_state()
    look_along(step, batch.pixels, 7, contracted_spacing=False)
    assert step.model.training
    for key, value in step.model.state_dict().items():
        assert torch.equal(value, before[key]), key
    for parameter, gradient in zip(step.model.parameters(), gradients, strict=True):
        assert torch.equal(parameter.grad, gradient)
    assert torch.equal(torch.get_rng_state(), generator)


@pytest.mark.parametrize("name", ["nerf", "fast_dense"])
def test_tiles_do_not_show(name):
    step, batch = a_system(name)
    whole = look_along(step, batch.pixels, 7, contracted_spacing=False)
    step.tile_points = 300
    parts = look_along(step, batch.pixels, 7, contracted_spacing=False)
    assert list(whole) == list(step.model.level_names)
    for level in whole:
        torch.testing.assert_close(parts[level], whole[level])


def test_a_histogram_holds_the_shares_that_it_was_given(tmp_path):
    shares = torch.zeros(PARTS)
    shares[0], shares[10] = 0.25, 0.5
    with SummaryWriter(str(tmp_path)) as writer:
        write_shares(writer, "along_rays/weight_fine", shares, 500)
    (event,) = EventAccumulator(str(tmp_path)).Reload().Histograms("along_rays/weight_fine")
    value = event.histogram_value
    mass = {round(limit, 6): count for limit, count in zip(value.bucket_limit, value.bucket, strict=True) if count}
    assert event.step == 500
    assert mass == {0.02: 0.25, 0.22: 0.5}
    assert value.sum / value.num == pytest.approx((0.25 * 0.01 + 0.5 * 0.21) / 0.75)
