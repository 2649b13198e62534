"""The two models whose shapes are known beforehand, small, with what trains them."""

import torch
from support.scenes import tiny_model
from support.steps import rays_of

from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.optimizers.table_adam import TableAdam
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.system import RadianceFieldSystem


def fast_model(level=MaskedLevel, encoder: Encoder | None = None, **sampler) -> RadianceModel:
    """A hash grid, or another encoder, behind an occupancy grid."""
    torch.manual_seed(1)
    if encoder is None:
        encoder = HashGridEncoder(num_levels=4, features_per_level=2, log2_table_size=10, min_resolution=4)
    field = NGPField(encoder, SphericalHarmonicsEncoder(2), width=16, density_bias=0.0)
    settings = {"resolution": 16, "num_steps": 48, "update_every": 4, "warmup_steps": 4} | sampler
    return RadianceModel({"fine": level(OccupancySampler(**settings), field)})


MODELS = {"nerf": lambda: tiny_model(density_activation="softplus"), "fast_dense": fast_model}
OPTIMIZERS = {
    "nerf": lambda groups: torch.optim.Adam(groups, lr=2e-3),
    "fast_dense": lambda groups: TableAdam(groups, lr=1e-2),
}


def static_system(name: str, scene, progress, num_steps: int, model=None, loss=None) -> RadianceFieldSystem:
    """The system that trains one of the two models on whole batches."""
    model = model or MODELS[name]()
    fit_parts(model, scene)
    train_step = TrainStep(
        objective=Objective(model, rays_of(scene), loss or MeanSquaredError(), scene.background),
        optimizer=OPTIMIZERS[name],
        schedule=ExponentialDecay(decay_rate=0.1),
        progress=progress,
        num_steps=num_steps,
        seed=0,
        clip_norm=1.0,
    )
    draw_weights(train_step)
    return RadianceFieldSystem(train_step, {"scene": {"splits": {"train": list(scene.splits["train"])}}})
