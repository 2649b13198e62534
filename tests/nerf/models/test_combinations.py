"""Every sampler, field and encoder that make sense together learn a ball together."""

from dataclasses import replace

import pytest
import torch
from support.scenes import BALL_RADIUS, ball_scene
from support.steps import rays_of

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.encoders.frequency import FrequencyEncoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.losses.depth import DepthLoss
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.losses.weighted_sum import WeightedSum
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.proposal_level import ProposalLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.optimizers.table_adam import TableAdam
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.samplers.importance import ImportanceSampler
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.proposal import ProposalSampler
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.progress import Progress, batch_sizes
from nerf_lightning.nerf.types.rays import KnownDepths, PixelIndex
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.step import TrainStep


def a_grid():
    return HashGridEncoder(num_levels=3, log2_table_size=10, min_resolution=4, max_resolution=24)


POSITIONS = {"frequency": lambda: FrequencyEncoder(4), "hash_grid": a_grid}
DIRECTIONS = {"frequency": lambda: FrequencyEncoder(2), "spherical_harmonics": lambda: SphericalHarmonicsEncoder(3)}
FIELDS = {
    "nerf_mlp": lambda p, d: NerfMLP(p, d, depth=2, width=32, skip=None, density_activation="softplus"),
    "ngp": lambda p, d: NGPField(p, d, width=32, density_bias=0.0),
}
MODELS = {
    "coarse and fine": lambda field: {
        "coarse": DenseLevel(StratifiedSampler(12), field()),
        "fine": DenseLevel(ImportanceSampler(12), field()),
    },
    "occupancy": lambda field: {"fine": RaggedLevel(OccupancySampler(resolution=16, num_steps=48), field())},
    "proposal": lambda field: {
        "proposal": ProposalLevel(StratifiedSampler(24), field()),
        "fine": DenseLevel(ProposalSampler(16), field()),
    },
}
CASES = [
    *((model, "nerf_mlp", "frequency", "frequency") for model in MODELS),
    ("occupancy", "ngp", "frequency", "frequency"),
]


def a_step(levels, scene, progress, loss):
    train_step = TrainStep(
        Objective(levels, rays_of(scene), loss, "random"), optimizer=lambda groups: TableAdam(groups, lr=0.02),
        schedule=ExponentialDecay(decay_rate=1.0), progress=progress, num_steps=60, seed=0, tile_points=4096,
    )  # fmt: skip
    draw_weights(train_step)
    return train_step


@pytest.mark.parametrize(("model", "field", "position", "direction"), CASES)
def test_it_learns(model, field, position, direction):
    torch.manual_seed(4)
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    levels = RadianceModel(MODELS[model](lambda: FIELDS[field](POSITIONS[position](), DIRECTIONS[direction]())))
    fit_parts(levels, scene)
    train_step = a_step(levels, scene, progress, ProposalLoss() if model == "proposal" else MeanSquaredError())
    optimizer = train_step.new_optimizer()
    loader = RayBatches(scene, progress, 0, 64)
    losses = []
    for _ in range(30):
        losses.append(float(train_step(loader.batch_at(0, progress.rays_seen), optimizer).losses[-1]))
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5])
    assert train_step.guard.skipped == 0


@pytest.mark.parametrize("model", MODELS)
def test_every_kind_of_level_learns_colors_and_known_depths(model):
    """The middle pixel of each view sees the ball's nearest point."""
    torch.manual_seed(4)
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    view, middle = torch.arange(8), torch.full((8,), 8)
    distance = scene.cameras.c2w[:, :, 3].norm(dim=-1) - BALL_RADIUS
    scene = replace(scene, depths=KnownDepths(PixelIndex(view, middle, middle), distance, torch.ones(8)))
    levels = RadianceModel(
        MODELS[model](lambda: FIELDS["ngp"](POSITIONS["hash_grid"](), DIRECTIONS["spherical_harmonics"]()))
    )
    fit_parts(levels, scene)
    plain = ProposalLoss() if model == "proposal" else MeanSquaredError()
    train_step = a_step(levels, scene, progress, WeightedSum({"photo": plain, "depth": DepthLoss(every=4, fade=1.0)}))
    loader, optimizer, lost = RayBatches(scene, progress, 0, 64, depth_every=4), train_step.new_optimizer(), []
    for _ in range(40):
        seen = train_step(loader.batch_at(0, progress.rays_seen), optimizer)
        depth = float(seen.terms["depth"][-1])
        lost.append((float(seen.losses[-1]) - depth, depth))
    photo, depth = (sum(each[-5:]) / sum(each[:5]) for each in zip(*lost, strict=True))
    assert photo < 0.7
    assert depth < 0.5


def test_rays_per_step_follow_the_budget_in_fixed_sizes():
    scene, progress = ball_scene(num_views=8, size=16), Progress()
    level = RaggedLevel(
        OccupancySampler(resolution=16, num_steps=48),
        FIELDS["ngp"](POSITIONS["hash_grid"](), DIRECTIONS["frequency"]()),
    )
    model = RadianceModel({"fine": level})
    fit_parts(model, scene)
    train_step = TrainStep(
        Objective(model, rays_of(scene), MeanSquaredError(), "white"), optimizer=lambda groups: TableAdam(groups),
        schedule=ExponentialDecay(decay_rate=1.0), progress=progress, num_steps=100, seed=0, sample_budget=1000,
    )  # fmt: skip
    draw_weights(train_step)
    optimizer = train_step.new_optimizer()
    loader = RayBatches(scene, progress, 0, 512)
    sizes = []
    for _ in range(40):
        sizes.append(progress.batch_rays)
        train_step(loader.batch_at(0, progress.rays_seen), optimizer)
    assert set(sizes) <= set(batch_sizes(512))
    changes = [place for place in range(1, 40) if sizes[place] != sizes[place - 1]]
    assert changes
    assert set(changes) <= {1, 16, 32}
    wanted = 1000 / model.points_per_ray(training=True)
    assert sizes[-1] <= wanted < 1.25 * sizes[-1]
