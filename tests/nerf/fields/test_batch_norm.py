"""Batch normalization: its equation in training and after it, and the batches that it needs whole."""

import copy

import pytest
import torch
from support.configs import composed
from support.running import refused
from support.scenes import ball_scene, tiny_field, tiny_model
from support.steps import make_step

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.fields.batch_norm import EPSILON, BatchNorm
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.part import parts_of
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Points
from nerf_lightning.training.build_step import build_step
from nerf_lightning.training.launch.fitting import require_one_process
from nerf_lightning.training.launch.trainer import TrainerSettings


@pytest.fixture
def layer():
    torch.manual_seed(0)
    layer = BatchNorm(3)
    torch.nn.init.uniform_(layer.weight)
    torch.nn.init.uniform_(layer.bias)
    return layer


def normalized(rows, mean, variance, layer):
    return layer.weight * (rows - mean) / (variance + EPSILON).sqrt() + layer.bias


def test_training_normalizes_by_the_rows_and_evaluation_by_running_means(layer):
    rows = 5.0 + 3.0 * torch.randn(40, 3)
    mean, variance = rows.mean(dim=0), rows.var(dim=0, correction=0)
    torch.testing.assert_close(layer(rows), normalized(rows, mean, variance, layer))
    layer.after_step(rows, rows, rows)
    expected = normalized(rows, 0.01 * mean, 0.99 + 0.01 * variance, layer)
    torch.testing.assert_close(layer.eval()(rows), expected)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_step_that_is_not_finite_leaves_the_running_means(layer, value):
    layer(torch.tensor([[1.0, value, 2.0], [3.0, 4.0, 5.0]]))
    layer.after_step(*torch.zeros(3, 1))
    assert (layer.running_mean.tolist(), layer.running_variance.tolist()) == ([0.0] * 3, [1.0] * 3)


def test_every_hidden_layer_of_the_article_has_it_and_no_head():
    field = tiny_field(depth=3, batch_norm=True)
    assert [type(each).__name__ for each in field.trunk[1]] == ["Linear", "BatchNorm", "ReLU"]
    assert sum(isinstance(part, BatchNorm) for part in parts_of(field)) == 3 + 1
    torch.manual_seed(1)
    positions = torch.rand(500, 3)
    seen = []
    for normalizing in (part for part in parts_of(field) if isinstance(part, BatchNorm)):
        normalizing.register_forward_hook(lambda _, inputs, rows: seen.append(rows.clone()))
    field(Points(positions, torch.nn.functional.normalize(positions, dim=-1)))
    for rows in seen:
        torch.testing.assert_close(rows.mean(dim=0), torch.zeros(rows.shape[1]), atol=1e-5, rtol=0)


def gradients_of(model, tile_points):
    step = make_step(tile_points, copy.deepcopy(model))
    step.new_optimizer().zero_grad()
    step.gradients(RayBatches(ball_scene(), step.progress, 0, 64).batch_at(0, 0), step.key)
    return [parameter.grad for parameter in step.objective.model.parameters()]


def test_no_tile_parts_a_batch():
    """Tiles of 200 points would each be normalized by themselves."""
    model = tiny_model(density_bias=0.5, batch_norm=True)
    assert make_step(200, copy.deepcopy(model)).tiles.points is None
    for whole, tiled in zip(gradients_of(model, None), gradients_of(model, 200), strict=True):
        assert torch.equal(whole, tiled)


def test_the_settings_of_a_run_follow():
    settings = TrainerSettings(accelerator="cpu", tile_points=4096)
    config = composed("train", "model=nerf_tiny", "field.batch_norm=true")
    build_step(config, settings, ball_scene(), Progress(64))
    assert (settings.tile_points, settings.measures_tile) == (None, False)


def test_several_processes_are_refused():
    step = make_step(None, tiny_model(batch_norm=True))
    require_one_process(step, 1)
    refused(require_one_process, step, 2, parts=("BatchNorm", "2 processes", "trainer.devices=1"))


@pytest.mark.parametrize(
    ("level", "sampler"),
    [(RaggedLevel, OccupancySampler), (MaskedLevel, OccupancySampler), (ProposalLevel, StratifiedSampler)],
)
def test_levels_whose_samples_depend_on_the_field_refuse_it(level, sampler):
    with pytest.raises(ValueError, match=r"BatchNorm.*leave field\.batch_norm out.*model=nerf"):
        level(sampler(8), tiny_field(batch_norm=True))


def test_a_new_attempt_forgets(layer):
    layer(torch.randn(9, 3))
    layer.after_step(*torch.zeros(3, 1))
    layer.reset_parameters()
    assert all(torch.equal(value, BatchNorm(3).state_dict()[name]) for name, value in layer.state_dict().items())
